"""Worlds in CoppeliaSim: its real client, against the test server or the one of the environment."""

import json
import os
import sys

import gymnasium as gym
import mujoco
import numpy as np
import pytest

pytest.importorskip("coppeliasim_zmqremoteapi_client", reason="the extra coppeliasim is missing")

import equipoise.envs  # noqa: F401  (registers the environments)
from equipoise.apps.coppeliasim.address import ENGINES, read_address
from equipoise.apps.coppeliasim.connection import Connection, as_plain
from equipoise.cli import main
from equipoise.control.grid import TRUNCATED
from equipoise.control.policy import KernelPolicy, TabularPolicy, shipped_policy
from equipoise.errors import InputError, LinkError, MissingExtraError, OutsideError, SettingsError
from equipoise.model.worlds import read_world
from equipoise.settings import resolve
from equipoise.testing import WorldConformance
from equipoise.worlds import Recorder, find_world, run_trial, setup_of, simulate
from equipoise.worlds.evaluation import Evaluation, evaluate
from equipoise.worlds.twin.physics import build
from tests.coppeliasim_server import PARAMETERS, RUNNING, STOPPED, CoppeliaSimServer

pytestmark = pytest.mark.compiled_only

POLICY = shipped_policy()
SEED, STREAM = 1, 7
REAL = os.environ.get("EQUIPOISE_COPPELIASIM")


@pytest.fixture(scope="module")
def server():
    with CoppeliaSimServer() as server:
        yield server
    assert not server.scene.things, "a scene was left behind"
    assert server.scene.parameters == PARAMETERS
    assert not any(server.scene.named.values()), "a marker was left behind"
    assert server.scene.state == STOPPED


def world_of(world):
    setup = setup_of(POLICY, world)
    return simulate(world, setup, seed=SEED, stream=STREAM), setup


def record(world, seconds):
    simulation, _ = world_of(world)
    loop, recorder = simulation.loop(), Recorder(7, round(seconds / POLICY.h))
    policy, trial = KernelPolicy(POLICY.kernel), simulation.draw(1).trial(0)
    return run_trial(loop, policy, trial, seconds, recorder), recorder.rows


# The conformance suite of worlds, on all kinds of them


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


class TestKinematicCoppeliaSim(WorldConformance):
    ENCODER = False

    @pytest.fixture(autouse=True)
    def _server(self, server):
        self.address = server.address

    def make(self):
        return world_of(self.address)


class TestDynamicCoppeliaSim(WorldConformance):
    @pytest.fixture(autouse=True)
    def _server(self, server):
        self.address = server.address

    def make(self):
        return world_of(f"{self.address}?engine=mujoco")


needs_one = pytest.mark.skipif(
    not REAL, reason="no CoppeliaSim: EQUIPOISE_COPPELIASIM names none (coppeliasim://HOST:PORT)"
)


@needs_one
class TestRealKinematicCoppeliaSim(WorldConformance):
    ENCODER = False

    def make(self):
        return world_of(REAL)


@needs_one
class TestRealDynamicCoppeliaSim(WorldConformance):
    def make(self):
        return world_of(f"{REAL}?engine=mujoco")


@pytest.mark.slow
@pytest.mark.parametrize("option", ["", "?engine=mujoco"])
def test_the_shipped_policy_balances_for_a_minute(server, option):
    (steps, cause, _), rows = record((REAL or server.address) + option, 60.0)
    assert (steps, cause) == (6000, TRUNCATED)
    assert np.abs(rows.state[:, 2]).max() < 0.15


# The scene


def test_the_bodies_in_coppeliasim_have_the_masses_of_the_twin(server):
    simulation, setup = world_of(f"{server.address}?engine=mujoco")
    loop, trial = simulation.loop(), simulation.draw(1).trial(0)
    loop.reset(trial)
    twin = build(setup.arm, loop.pendulum, simulation.numbers)
    matrices = []
    for model in (server.scene.model, twin):
        data, M = mujoco.MjData(model), np.zeros((8, 8))
        data.qpos[:] = [*setup.arm.home, 0.1]
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, M)
        matrices.append((M, data.qfrc_bias.copy(), model.jnt_range[:7], model.dof_damping[7]))
    for ours, theirs in zip(*matrices, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-10)
    assert server.scene.model.dof_frictionloss[7] == pytest.approx(twin.dof_frictionloss[7])


def test_the_flange_in_coppeliasim_is_where_the_kinematics_say(server):
    simulation, setup = world_of(server.address)
    rig, q = simulation.rig, setup.arm.home_free + np.array([0.1, -0.2, 0.3, 0.1, -0.3, 0.2])
    rig.place(q)
    position, R = rig.pose(rig.scene.flange)
    expected = setup.arm.pose(q)
    np.testing.assert_allclose(position, expected.position, atol=1e-12)
    np.testing.assert_allclose(R, expected.rotation, atol=1e-12)
    np.testing.assert_allclose(rig.joints(), setup.arm.with_held(q), atol=1e-15)


def test_the_kinematic_world_is_the_papers_plant_but_for_the_curve_of_its_track(server):
    settled = 100
    (_, cause, _), ours = record(server.address, 0.01 * settled)
    (_, same, _), ideal = record("ideal", 0.01 * settled)
    assert cause == same == TRUNCATED
    # Second differences of places are exact for the accelerated path, not for the pose error in it.
    np.testing.assert_allclose(ours.state[:20], ideal.state[:20], atol=5e-3)
    np.testing.assert_allclose(ours.joints[:5], ideal.joints[:5], atol=1e-3)


def test_the_drives_follow_with_the_lag_of_the_twin(server):
    simulation, _ = world_of(f"{server.address}?engine=mujoco")
    loop = simulation.loop()
    loop.reset(simulation.draw(1).trial(0))
    rig, q = simulation.rig, simulation.params.home.copy()
    rig.aim(q + 1e-4)  # more would meet the limits of torque
    before = rig.joints()
    rig.step()
    share = (rig.joints() - before)[list(simulation.setup.arm.free)] / 1e-4
    assert share == pytest.approx(1.0 - np.exp(-0.005 / simulation.numbers.lag), abs=0.06)


# The connection


def test_without_a_server_a_message_comes_instead_of_a_wait_for_ever():
    silent = r"no CoppeliaSim answers at 127\.0\.0\.1:9 within 0\.2 s.*try port 10: after a crash"
    with pytest.raises(LinkError, match=silent):
        Connection("127.0.0.1", 9, patience=0.2)


def test_a_host_that_is_no_address_is_refused():
    with pytest.raises(InputError, match="is no address"):
        Connection("no host", 23000)


def test_an_error_of_coppeliasim_is_one_readable_line(server):
    sim = Connection("127.0.0.1", server.port)
    with pytest.raises(OutsideError) as caught:
        sim.call("getJointPosition", 12345)
    assert str(caught.value) == (
        f"CoppeliaSim at 127.0.0.1:{server.port} refuses getJointPosition: object does not exist."
    )
    with pytest.raises(OutsideError, match=r"has no sim\.warp_drive; install version 4\.6"):
        sim.constant("warp_drive")
    sim.close()
    server.errors.clear()


def test_numbers_of_numpy_are_sent_as_numbers_of_python(server):
    sim = Connection("127.0.0.1", server.port)
    dummy = sim.call("createDummy", np.float32(0.5))
    pose = np.array([1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0])
    sim.call("setObjectPose", np.int64(dummy), pose, np.int32(-1))
    assert sim.call("getObjectPose", np.uint32(dummy)) == pytest.approx(pose.tolist())
    sim.call("removeObjects", [np.int64(dummy)])
    sim.close()
    plain = as_plain({"a": (np.bool_(True), np.arange(2))})
    assert plain == {"a": [True, [0, 1]]}
    assert type(plain["a"][0]) is bool


def test_the_main_module_is_left_as_it_was(server, monkeypatch):
    main_module = sys.modules["__main__"]
    assert not hasattr(main_module, "require")
    Connection("127.0.0.1", server.port).close()
    assert not hasattr(main_module, "require")
    monkeypatch.setattr(main_module, "require", 5, raising=False)
    Connection("127.0.0.1", server.port).close()
    assert main_module.require == 5


def test_without_the_client_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "coppeliasim_zmqremoteapi_client", None)
    with pytest.raises(MissingExtraError, match=r"'\.\[coppeliasim\]'"):
        Connection("127.0.0.1", 9)


def test_a_simulation_of_the_user_goes_on():
    with CoppeliaSimServer() as server:
        server.scene.sim_startSimulation()
        with pytest.raises(OutsideError, match="runs a simulation; stop it"):
            world_of(server.address)
        assert server.scene.state == RUNNING


def test_a_simulation_advances_with_each_step_alone_also_after_a_stop(server):
    simulation, _ = world_of(server.address)
    loop, trials = simulation.loop(), simulation.draw(2)
    for row in range(2):  # stopSimulation forgets the stepping
        loop.reset(trials.trial(row))
        before = server.scene.steps
        for _ in range(5):
            loop.step(0.0)
        assert server.scene.steps == before + 5
        assert list(server.scene.levels.values()).count(1) == 1


def test_a_second_world_ends_the_first_one(server):
    first, _ = world_of(server.address)
    loop, trial = first.loop(), first.draw(1).trial(0)
    second, _ = world_of(f"{server.address}?engine=mujoco")
    with pytest.raises(LinkError, match="another world of this process took"):
        loop.reset(trial)
    del first, loop
    second.loop().reset(trial)
    second.rig.close()
    assert not server.scene.things
    assert server.scene.parameters == PARAMETERS


# Addresses


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("coppeliasim://", "is no address"),
        ("coppeliasim://host:port", "is no address"),
        ("coppeliasim://host:99999", "is no address"),
        ("coppeliasim://host:0", "is no address"),
        ("coppeliasim://host/scene", "is no address"),
        ("coppeliasim://host?engine", "is no address"),
        ("coppeliasim://host?speed=2", "is no address"),
        ("coppeliasim://host?engine=ode&engine=ode", "is no address"),
        ("coppeliasim://host?engine=physx", "choose one of mujoco, bullet, ode, newton, vortex"),
        ("coppeliasim://host?twin=harsh", "add an engine"),
        ("coppeliasim://host?engine=ode&twin=none", "no set of that name"),
    ],
)
def test_a_wrong_address_is_refused(text, message):
    with pytest.raises(SettingsError, match=message):
        find_world(text)


@pytest.mark.parametrize("engine", ENGINES)
def test_the_numbers_of_a_world_are_those_that_act(engine):
    found = read_address(f"coppeliasim://[::1]:24000?engine={engine}&twin=harsh")
    twin = read_world("twin:harsh").settings
    assert (found.host, found.port, found.engine) == ("::1", 24000, engine)
    assert found.numbers.transport == twin.transport
    assert found.numbers.counts_per_rev == twin.counts_per_rev
    assert found.numbers.joint_noise == found.numbers.drag == 0.0
    assert (found.numbers.coulomb == 0.0) == (engine != "mujoco")


# The verbs and the environments


def test_evaluate_runs_there_and_its_file_names_the_world(server, tmp_path, capsys):
    world, out = f"{server.address}?engine=mujoco", tmp_path / "evaluation.json"
    short = ["--trials", "2", "--duration", "0.5", "--no-baselines", "--json", "--out", str(out)]
    main(["evaluate", "--world", world, *short])
    assert json.loads(capsys.readouterr().out)["world"] == world
    found = Evaluation.load(out)
    assert found.results.survival == (0.5, 0.5)
    assert found.world_settings == read_address(world).numbers


def test_python_policies_and_tables_run_the_same_trials_there(server):
    settings = resolve(overrides=["evaluation.trials=2", "evaluation.duration=0.3"])
    first = evaluate(POLICY, settings, world=server.address, with_baselines=False, workers=2)
    again = evaluate(POLICY, settings, world=server.address, with_baselines=False)
    assert first.results == again.results


def test_the_environment_runs_there_one_at_a_time(server):
    given = {"pendulum": POLICY.pendulum, "arm": POLICY.arm, "settings": POLICY.settings}
    env = gym.make("equipoise/Balance-v0", world=server.address, duration=0.2, **given)
    for seed in (3, 3):
        observation, info = env.reset(seed=seed)
        assert info["state"] == pytest.approx(observation)
        steps, over = 0, False
        while not over:
            observation, _, terminated, over, info = env.step(np.array([0.5]))
            assert not terminated
            steps += 1
        assert steps == 20
        assert info["outcome"] == "lasted"
    env.close()
    with pytest.raises(InputError, match="2 environments at once, and this world has 1"):
        gym.make_vec("equipoise/Balance-v0", num_envs=2, world=server.address)
    with pytest.raises(InputError, match="has no encoder"):
        gym.make("equipoise/Balance-v0", world=server.address, observe="raw")


@pytest.mark.parametrize("option", ["", "?engine=mujoco"])
def test_train_runs_there_and_its_policy_says_so(server, option, tmp_path, capsys):
    world, out = server.address + option, tmp_path / "policy.json"
    few = ["episode_duration=0.3", "episodes=4"]
    less = ["every=2", "round_trials=10", "rounds=1", "duration=0.5", "test_trials=20"]
    chosen = [f"learning.{one}" for one in few] + [f"selection.{one}" for one in less]
    words = [word for one in chosen for word in ("--set", one)]
    small = ["--target", "0", "--learners", "1", "--json", "--out", str(out)]
    main(["train", "--world", world, *small, *words])
    said = json.loads(capsys.readouterr().out)
    assert said["episodes"] == 4
    assert said["steps"] > 20
    assert json.loads(out.read_text())["provenance"]["inputs"]["world"] == world
    policy = TabularPolicy.load(out)
    assert (policy.actuator.kind == "ideal") == (option == "")
