"""Worlds in CoppeliaSim: its real client, against the test server or the one of the environment."""

import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

pytest.importorskip("coppeliasim_zmqremoteapi_client", reason="the extra coppeliasim is missing")

from equipoise.apps.coppeliasim.connection import Connection
from equipoise.cli import main
from equipoise.control.grid import TRUNCATED
from equipoise.control.policy import KernelPolicy, TabularPolicy, shipped_policy
from equipoise.errors import InputError, LinkError, MissingExtraError, OutsideError, SettingsError
from equipoise.testing import WorldConformance
from equipoise.worlds import Recorder, predicted, run_trial, setup_of, simulate
from tests.coppeliasim_server import PARAMETERS, RUNNING, STOPPED, CoppeliaSimServer

pytestmark = [pytest.mark.full, pytest.mark.compiled_only]

POLICY = shipped_policy()
REAL = os.environ.get("EQUIPOISE_COPPELIASIM")


@pytest.fixture(scope="module")
def server():
    with CoppeliaSimServer() as server:
        yield server
    assert not server.scene.things, "a scene was left behind"
    assert server.scene.parameters == PARAMETERS
    assert server.scene.state == STOPPED


def world_of(world):
    setup = setup_of(POLICY, world)
    return simulate(world, setup, seed=1, stream=7), setup


def record(world, seconds):
    simulation, _ = world_of(world)
    loop, recorder = simulation.loop(), Recorder()
    policy, trial = KernelPolicy(POLICY.kernel), simulation.draw(1).trial(0)
    return run_trial(loop, policy, trial, seconds, recorder), recorder.rows


class TestIdeal(WorldConformance):
    ENCODER = False

    def make(self):
        return world_of("ideal")


class TestModel(WorldConformance):
    def make(self):
        return world_of("model")


class TestTwin(WorldConformance):
    def make(self):
        return world_of("twin:nominal")


class TestCoppeliaSim(WorldConformance):
    ENCODER = False

    @pytest.fixture(autouse=True)
    def _server(self, server):
        self.address = server.address

    def make(self):
        return world_of(self.address)


@pytest.mark.skipif(not REAL, reason="EQUIPOISE_COPPELIASIM names none (coppeliasim://HOST:PORT)")
class TestRealCoppeliaSim(WorldConformance):
    ENCODER = False

    def make(self):
        return world_of(REAL)


@pytest.mark.slow
def test_the_shipped_policy_balances_for_a_minute(server):
    (steps, cause, _), rows = record(REAL or server.address, 60.0)
    assert (steps, cause) == (6000, TRUNCATED)
    assert np.abs(rows.state[:, 2]).max() < 0.15


def test_the_flange_in_coppeliasim_is_where_the_kinematics_say(server):
    simulation, setup = world_of(server.address)
    rig, q = simulation.rig, setup.arm.home_free + np.array([0.1, -0.2, 0.3, 0.1, -0.3, 0.2])
    rig.place(q)
    position, R = rig.flange()
    expected = setup.arm.kinematics(q)
    np.testing.assert_allclose(position, expected.position, atol=1e-12)
    np.testing.assert_allclose(R, expected.rotation, atol=1e-12)
    np.testing.assert_allclose(rig.joints(), setup.arm.with_held(q), atol=1e-15)


def test_the_world_is_the_papers_plant_but_for_the_curve_of_its_track(server):
    (_, cause, _), ours = record(server.address, 1.0)
    (_, same, _), ideal = record("ideal", 1.0)
    assert cause == same == TRUNCATED
    # Second differences of places are exact for the accelerated path, not for the pose error in it.
    np.testing.assert_allclose(ours.state[:20], ideal.state[:20], atol=5e-3)
    np.testing.assert_allclose(ours.joints[:5], ideal.joints[:5], atol=1e-3)


# The connection


def test_errors_of_the_connection_are_one_message(server, monkeypatch):
    with pytest.raises(LinkError):
        Connection("127.0.0.1", 9, patience=0.2)
    with pytest.raises(InputError):
        Connection("no host", 23000)
    sim = Connection("127.0.0.1", server.port)
    with pytest.raises(OutsideError, match=r"refuses getJointPosition: object does not exist\.$"):
        sim.call("getJointPosition", 12345)
    with pytest.raises(OutsideError):
        sim.constant("warp_drive")
    sim.close()
    server.errors.clear()
    monkeypatch.setitem(sys.modules, "coppeliasim_zmqremoteapi_client", None)
    with pytest.raises(MissingExtraError):
        Connection("127.0.0.1", 9)


# The simulation


def test_a_simulation_of_the_user_goes_on():
    with CoppeliaSimServer() as server:
        server.scene.sim_startSimulation()
        with pytest.raises(OutsideError, match="runs a simulation"):
            world_of(server.address)
        assert server.scene.state == RUNNING


def test_a_second_world_ends_the_first_one(server):
    first, _ = world_of(server.address)
    loop, trial = first.loop(), first.draw(1).trial(0)
    second, _ = world_of(server.address)
    with pytest.raises(LinkError, match="another world of this process took"):
        loop.reset(trial)
    second.loop().reset(trial)
    second.rig.close()
    assert not server.scene.things
    assert server.scene.parameters == PARAMETERS


def restart(scene):
    scene.sim_stopSimulation()
    scene.finish()
    scene.sim_startSimulation()


@pytest.mark.parametrize(
    "change",
    [
        lambda scene: scene.sim_pauseSimulation(),
        restart,
        lambda scene: scene.sim_removeObjects(list(scene.things)),
    ],
    ids=["pause", "restart", "remove"],
)
def test_a_change_by_another_program_is_an_error_not_a_fall(change):
    with CoppeliaSimServer() as server:
        simulation, _ = world_of(server.address)
        loop, policy = simulation.loop(), KernelPolicy(POLICY.kernel)
        loop.reset(simulation.draw(1).trial(0))
        loop.step(0.0)
        change(server.scene)

        def go_on():
            for _ in range(3):
                loop.step(policy.act(predicted(loop)))

        with pytest.raises(OutsideError):
            go_on()
        simulation.rig.close()


def test_ctrl_c_ends_a_run_at_once_and_leaves_nothing(tmp_path):
    with CoppeliaSimServer() as server:
        verb = ["evaluate", "--world", server.address, "--trials", "50", "--no-baselines"]
        process = subprocess.Popen(
            [sys.executable, "-m", "equipoise", *verb], stderr=subprocess.PIPE, cwd=tmp_path
        )
        until = time.monotonic() + 120.0
        while server.scene.time < 0.2 and process.poll() is None and time.monotonic() < until:
            time.sleep(0.05)
        process.send_signal(signal.SIGINT)
        _, stderr = process.communicate(timeout=30)
        assert process.returncode == 130
        assert b"Traceback" not in stderr
        assert not list(tmp_path.iterdir())
        assert not server.scene.things
        assert server.scene.parameters == PARAMETERS


@pytest.mark.parametrize("rest", ["", "host:port", "host:99999", "host/scene", "u@host"])
def test_a_wrong_address_is_refused(rest):
    with pytest.raises(SettingsError, match="is no address"):
        world_of(f"coppeliasim://{rest}")


# The verbs


def test_train_runs_there_and_its_policy_says_so(server, tmp_path, capsys):
    out = tmp_path / "policy.json"
    few = ["episode_duration=0.3", "episodes=4"]
    less = ["every=2", "round_trials=10", "rounds=1", "duration=0.5", "test_trials=20"]
    chosen = [f"learning.{one}" for one in few] + [f"selection.{one}" for one in less]
    words = [word for one in chosen for word in ("--set", one)]
    small = ["--target", "0", "--learners", "1", "--json", "--out", str(out)]
    main(["train", "--world", server.address, *small, *words])
    assert json.loads(capsys.readouterr().out)["episodes"] == 4
    assert json.loads(out.read_text())["provenance"]["inputs"]["world"] == server.address
    assert TabularPolicy.load(out).actuator.kind == "ideal"
