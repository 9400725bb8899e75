"""Worlds in CoppeliaSim: its real client, against the test server or the one of the environment."""

import json
import os
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

pytest.importorskip("coppeliasim_zmqremoteapi_client", reason="the extra coppeliasim is missing")

from equipoise import RunLog, iiwa, read_urdf
from equipoise.cli import main
from equipoise.control.policy import KernelPolicy, TabularPolicy, shipped_policy
from equipoise.coppeliasim.rig import FORGOTTEN, Connection, CoppeliaRig
from equipoise.errors import InputError, LinkError, MissingExtraError, OutsideError, SettingsError
from equipoise.model.grid import TRUNCATED
from equipoise.paper import PHI_LIMIT
from equipoise.simulation import TrialRecorder, run_trial, setup_of, simulate
from equipoise.testing import WorldConformance
from tests.arm.witnesses import ELBOW, ELBOW_HOME
from tests.coppeliasim_server import RUNNING, CoppeliaSimServer, Scene

pytestmark = pytest.mark.full

POLICY = shipped_policy()
REAL = os.environ.get("EQUIPOISE_COPPELIASIM")


@pytest.fixture(scope="module")
def server():
    with CoppeliaSimServer() as server:
        yield server
    assert server.scene.as_left


def world_of(world):
    setup = setup_of(POLICY, world)
    return simulate(world, setup, seed=1, stream=7), setup


def rig_at(server, arm=POLICY.arm):
    return CoppeliaRig("127.0.0.1", server.port, arm, 0.01)


def record(world, seconds):
    simulation, _ = world_of(world)
    loop, recorder = simulation.loop(), TrialRecorder()
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
    (steps, cause, *_), rows = record(REAL or server.address, 60.0)
    assert (steps, cause) == (6000, TRUNCATED)
    assert np.abs(rows.state[:, 2]).max() < 0.15


@pytest.mark.parametrize(
    "arm", [iiwa(7), read_urdf(ELBOW, home=ELBOW_HOME)], ids=["iiwa7", "elbow"]
)
def test_the_flange_in_coppeliasim_is_where_the_kinematics_say(server, arm):
    rig, q = rig_at(server, arm), arm.home_free + np.array([0.1, -0.2, 0.3, 0.1, -0.3, 0.2])
    for angles in (arm.home_free, q):
        position, R = rig.place(angles)
        expected = arm.kinematics(angles)
        np.testing.assert_allclose(position, expected.position, atol=1e-12)
        np.testing.assert_allclose(R, expected.rotation, atol=1e-12)
        np.testing.assert_allclose(rig.joints(), arm.with_held(angles), atol=1e-15)


def test_an_arm_that_is_not_that_of_the_model_is_refused(monkeypatch):
    before = Scene.sim_setJointInterval
    monkeypatch.setattr(  # limits that exclude home
        Scene, "sim_setJointInterval", lambda scene, joint, *_: before(scene, joint, False, [1, 1])
    )
    with CoppeliaSimServer() as server:
        with pytest.raises(OutsideError, match=r"flange .* mm from its place"):
            rig_at(server)
        assert server.scene.as_left


def test_the_world_is_the_papers_plant_but_for_the_curve_of_its_track(server):
    (_, cause, *_), ours = record(server.address, 1.0)
    (_, same, *_), ideal = record("ideal", 1.0)
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
    refusal = r"refuses getJointPosition \(354: .* object does not exist\.\)"
    with pytest.raises(OutsideError, match=refusal):
        sim.call("getJointPosition", 12345)
    sim.close()
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
    with pytest.raises(OutsideError, match="object does not exist"):
        loop.reset(trial)
    other = second.loop()
    other.reset(trial)
    first.rig.close()  # changes nothing of the second
    assert other.step(0.0) == TRUNCATED
    second.rig.close()
    assert server.scene.as_left


def restart(scene):
    scene.sim_stopSimulation()
    scene.finish()
    scene.sim_startSimulation()


def move_flange(scene):
    scene.added("flange").local[0, 3] += 1e-4


CHANGES = {
    "pause": Scene.sim_pauseSimulation,
    "restart": restart,
    "remove": lambda scene: scene.sim_removeObjects(scene.ours),
    "flange": move_flange,
    "time step": lambda scene: scene.parameters["Float"].update({1: 0.02}),
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_a_change_by_another_program_is_an_error_not_a_fall(change, tmp_path, capsys):
    with CoppeliaSimServer() as server:
        changes = iter([change])

        def watch(_):
            if server.scene.time > 0.1:
                next(changes, lambda _: None)(server.scene)

        server.watch = watch
        few = ["--trials", "1", "--duration", "0.5", "--no-baselines"]
        assert main(["evaluate", "--world", server.address, *few]) == 3
        assert not list(changes)
        assert not list(tmp_path.iterdir())
        assert "end that program, and start again" in " ".join(capsys.readouterr().err.split())
        assert server.scene.as_left


def test_a_client_that_holds_the_simulation_is_an_error_within_the_time_of_a_call(server):
    other = Connection("127.0.0.1", server.port)
    other.call("setStepping", True)
    rig = rig_at(server)
    rig.sim = Connection("127.0.0.1", server.port, patience=0.5)
    begin = time.monotonic()
    with pytest.raises(OutsideError, match="does not finish step .* another client holds its"):
        rig.step()
    assert time.monotonic() - begin < 2.0
    other.close()
    rig.close()


def test_coppeliasim_forgets_a_silent_client_and_the_world_says_so(server):
    rig = rig_at(server)
    rig.step()
    rig.step()
    server.later += FORGOTTEN + 1.0
    with pytest.raises(OutsideError, match="or Equipoise paused for more than 60 s"):
        rig.step()
    rig.close()


# Ends


@pytest.mark.parametrize("again", [0, 1, 2], ids=["once", "twice", "thrice"])
@pytest.mark.parametrize("seed", range(2))
def test_ctrl_c_at_any_moment_leaves_the_simulator_as_it_was(server, tmp_path, capsys, again, seed):
    rng = np.random.default_rng((seed, again))
    delays = np.cumsum([0.0, *rng.uniform(0.001, 0.15, again)])[::-1]
    timers = [threading.Timer(t, os.kill, (os.getpid(), signal.SIGINT)) for t in delays]
    first = server.requests + int(rng.integers(5, 400))

    def watch(number):
        if number == first:
            for timer in timers:
                timer.start()

    server.watch = watch
    try:
        assert main(["evaluate", "--world", server.address, "--no-baselines"]) == 130
        for timer in timers:
            timer.join()
    finally:
        server.watch = lambda _: None
        signal.signal(signal.SIGINT, signal.default_int_handler)
    assert "Traceback" not in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
    assert server.scene.as_left


@pytest.mark.parametrize(
    "moment",
    [
        lambda scene: len(scene.ours) == 2,
        lambda scene: len(scene.ours) == 10,
        lambda scene: scene.time > 0.1,
    ],
    ids=["begun", "half built", "trial"],
)
def test_the_next_run_undoes_one_that_was_killed(moment, tmp_path):
    with CoppeliaSimServer() as server:
        verb = ["evaluate", "--world", server.address, "--no-baselines"]
        process = subprocess.Popen([sys.executable, "-m", "equipoise", *verb], cwd=tmp_path)
        server.watch = lambda _: moment(server.scene) and process.kill()
        process.wait(60)
        server.watch = lambda _: None
        assert server.scene.ours
        rig_at(server).close()
        assert server.scene.as_left


@pytest.mark.parametrize("rest", ["", "host:port", "host:99999", "host/scene", "u@host"])
def test_a_wrong_address_is_refused(rest):
    with pytest.raises(SettingsError, match="is no address"):
        world_of(f"coppeliasim://{rest}")


# The verbs


def test_a_hanging_pendulum_is_swung_up_there(server, tmp_path, capsys):
    out, hanging = tmp_path / "run.mcap", ["--start", "hanging", "--duration", "0.5"]
    verb = ["--world", server.address, *hanging]
    assert main(["evaluate", *verb, "--trials", "1", "--no-baselines", "--json"]) == 0
    assert 2.0 < json.loads(capsys.readouterr().out)["upright_max_s"] < 15.0
    assert main(["deploy", *verb, "--out", str(out)]) == 0
    run = RunLog.load(out)
    assert run.survival == run.end.survival == 0.5
    assert run.release > 2.0
    assert abs(run.tables["truth"]["phi"][0]) > 3.1
    assert np.abs(run.truth.phi).max() < PHI_LIMIT


def test_train_runs_there_and_its_policy_says_so(server, tmp_path, capsys):
    out = tmp_path / "policy.json"
    few = ["episode_duration=0.3", "episodes=4"]
    less = ["every=2", "trials=4", "duration=0.5", "test_trials=20"]
    chosen = [f"learning.{one}" for one in few] + [f"selection.{one}" for one in less]
    words = [word for one in chosen for word in ("--set", one)]
    small = ["--target", "0", "--attempts", "1", "--json", "--out", str(out)]
    main(["train", "--world", server.address, *small, *words])
    assert json.loads(capsys.readouterr().out)["episodes"] == 4
    assert json.loads(out.read_text())["provenance"]["inputs"]["world"] == server.address
    assert TabularPolicy.load(out).actuator.kind == "ideal"
