"""Drivers of a CoppeliaSim: what they set, what others change, and how they end.

Each test sees CoppeliaSim through its protocol alone, and runs against the test server, and against
the real one of the environment variable `EQUIPOISE_COPPELIASIM`.
"""

import os
import re
import signal
import subprocess
import sys
import time
from contextlib import contextmanager

import numpy as np
import pytest

pytest.importorskip("coppeliasim_zmqremoteapi_client", reason="the extra coppeliasim is missing")

from equipoise.apps.coppeliasim.address import ENGINES, read_address
from equipoise.apps.coppeliasim.connection import Connection
from equipoise.apps.coppeliasim.rig import MARKER, Marker, _parameter, _set
from equipoise.apps.coppeliasim.scene import build_scene
from equipoise.control.policy import KernelPolicy, shipped_policy
from equipoise.errors import OutsideError
from equipoise.worlds import predicted, setup_of, simulate
from tests.coppeliasim_server import INSTALLED, CoppeliaSimServer

pytestmark = pytest.mark.compiled_only

POLICY = shipped_policy()
REAL = os.environ.get("EQUIPOISE_COPPELIASIM")
SLOW_SCENE = {"floatparam_simulation_time_step": 0.05, "floatparam_physicstimestep": 0.05}
"""Parameters of a scene whose engine takes one step in each step of the simulation."""
WATCHED = (*SLOW_SCENE, "intparam_idle_fps", "intparam_dynamic_engine")


@pytest.fixture(
    params=[
        "test server",
        pytest.param(
            "real", marks=pytest.mark.skipif(not REAL, reason="EQUIPOISE_COPPELIASIM names none")
        ),
    ]
)
def address(request):
    if request.param == "real":
        yield REAL
        return
    with CoppeliaSimServer() as server:
        yield server.address


@pytest.fixture
def other(address):
    """Return another client; afterwards nothing of a driver may be left."""
    place = read_address(address)
    sim = Connection(place.host, place.port)
    before = watched(sim)
    yield sim
    assert watched(sim) == before
    assert not is_running(sim)
    assert not sim.call("getNamedStringParam", MARKER)
    assert sim.call("getObject", "/equipoise", {"noError": True}) == -1
    sim.close()


def watched(sim):
    return {name: _parameter(sim, name) for name in WATCHED}


def is_running(sim):
    return sim.call("getSimulationState") != sim.constant("simulation_stopped")


def world_of(world):
    return simulate(world, setup_of(POLICY, world), seed=1, stream=7)


@contextmanager
def running_loop(world):
    """Yield a closed loop in the middle of a trial, and its simulation."""
    simulation = world_of(world)
    loop = simulation.loop()
    loop.reset(simulation.draw(1).trial(0))
    for _ in range(5):
        loop.step(0.0)
    yield loop, simulation
    simulation.rig.close()


def wait_for(condition, seconds=60.0):
    until = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < until, "waited in vain"
        time.sleep(0.05)


@contextmanager
def evaluating(address, out, option=""):
    """Yield a process that evaluates trials of a minute, in the middle of the first one."""
    place = read_address(address)
    watcher = Connection(place.host, place.port)

    def is_in_a_trial():  # the fall of the pendulum before it takes 0.1 s
        return is_running(watcher) and watcher.call("getSimulationTime") > 0.2

    verb = ["evaluate", "--world", address + option, "--trials", "50", "--no-baselines"]
    process = subprocess.Popen(
        [sys.executable, "-m", "equipoise", *verb, "--out", str(out)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=out.parent,
    )
    try:
        wait_for(lambda: is_in_a_trial() or process.poll() is not None)
        assert process.poll() is None, process.stderr.read()
        yield process
    finally:
        process.kill()
        process.wait()
        watcher.close()


# What a driver sets


def test_the_pendulum_is_released_at_the_drawn_rate_in_both_directions(address, other):
    simulation = world_of(f"{address}?engine=mujoco")
    loop, trials = simulation.loop(), simulation.draw(12)
    rates = trials.start[:, 3]
    for row in (int(np.argmin(rates)), int(np.argmax(rates))):
        trial = trials.trial(row)
        loop.reset(trial)
        # Led for four steps, as by a hand; a rate of the wrong sign misses by 0.2 rad/s and more.
        assert loop.state()[2:] == pytest.approx(trial.start[2:], abs=0.02)
    assert rates.min() < -0.1 < 0.1 < rates.max()
    simulation.rig.close()


@pytest.mark.parametrize("option", ["", "?engine=mujoco"])
def test_a_scene_of_50_ms_comes_back(address, other, option):
    own = {name: _parameter(other, name) for name in SLOW_SCENE}
    _set(other, SLOW_SCENE)
    with running_loop(address + option):
        assert watched(other)["floatparam_simulation_time_step"] < 0.02
    assert {name: _parameter(other, name) for name in SLOW_SCENE} == pytest.approx(SLOW_SCENE)
    _set(other, own)


@pytest.mark.parametrize("engine", ENGINES)
def test_an_engine_that_moves_nothing_is_an_error(address, other, engine):
    if f"physics_{engine}" in INSTALLED:
        world_of(f"{address}?engine={engine}").rig.close()
        return
    if address == REAL:
        pytest.skip("its plug-in may be installed there")
    message = f"the engine {engine} of .* does not run: a pendulum .* fell by 0.000 rad in 0.1 s"
    with pytest.raises(OutsideError, match=message):
        world_of(f"{address}?engine={engine}")


# What others change


def stop_it(sim):
    sim.call("stopSimulation")
    wait_for(lambda: not is_running(sim))


def restart_it(sim):
    stop_it(sim)
    sim.call("startSimulation")


def pause_it(sim):
    sim.call("pauseSimulation")


def remove_the_arm(sim):
    base = sim.call("getObject", "/equipoise", {})
    sim.call("removeObjects", sim.call("getObjectsInTree", base))


def remove_the_marker(sim):
    sim.call("setNamedStringParam", MARKER, "")


def change_the_idle_rate(sim):
    sim.call("setInt32Param", sim.constant("intparam_idle_fps"), 4)


@pytest.mark.parametrize("option", ["", "?engine=mujoco"])
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (stop_it, "stopped the simulation: the trial has no result"),
        (restart_it, "advanced the simulation by .* s in a step of"),
        (pause_it, "paused the simulation"),
        (remove_the_arm, "object does not exist"),
        (change_the_idle_rate, "set sim.intparam_idle_fps to 4, expected 0"),
    ],
)
def test_a_change_by_another_program_is_an_error(address, other, option, change, message):
    policy = KernelPolicy(POLICY.kernel)

    def go_on():
        for _ in range(250):  # longer than the time between two checks
            loop.step(policy.act(predicted(loop)))

    with running_loop(address + option) as (loop, _):
        change(other)
        with pytest.raises(OutsideError, match=message):
            go_on()


def test_a_stop_between_the_last_step_and_its_measurements_is_no_fall(address, other):
    with running_loop(f"{address}?engine=mujoco") as (loop, simulation):
        rig = simulation.rig
        joints = rig.joints

        def joints_after_a_stop():
            stop_it(other)
            other.call("setJointPosition", rig.scene.joints[1], 1.5)
            other.call("setJointPosition", rig.scene.spindle, 1.5)
            rig.joints = joints
            return joints()

        rig.joints = joints_after_a_stop
        with pytest.raises(OutsideError, match="stopped the simulation"):
            loop.step(0.0)


def test_a_driver_that_lost_its_marker_leaves_coppeliasim_to_the_other_one(address, other):
    with running_loop(address) as (_, simulation):
        marker = other.call("getNamedStringParam", MARKER)
        theirs = Marker.model_validate_json(marker).model_copy(update={"key": "theirs"})
        other.call("setNamedStringParam", MARKER, theirs.model_dump_json())
        with pytest.raises(OutsideError, match="and took it over"):
            simulation.rig.check()
        simulation.rig.close()
        assert is_running(other)
        assert _parameter(other, "intparam_idle_fps") == 0
    world_of(address).rig.close()  # a marker of this process without a rig is a lost one


def test_a_driver_on_another_computer_and_a_foreign_marker_are_refused(address, other):
    marker = Marker(key="far", host="far\x1b[2J", pid=4711, before={})
    other.call("setNamedStringParam", MARKER, marker.model_dump_json())
    with pytest.raises(OutsideError, match=r"^process 4711 on far\\x1b\[2J drives the CoppeliaSim"):
        world_of(address)
    other.call("setNamedStringParam", MARKER, "mine")
    with pytest.raises(OutsideError, match="no driver of this version wrote; restart"):
        world_of(address)
    remove_the_marker(other)


# Processes


def test_a_stop_by_another_program_ends_a_run_without_a_result(address, other, tmp_path):
    out = tmp_path / "evaluation.json"
    with evaluating(address, out, "?engine=mujoco") as process:
        stop_it(other)
        stdout, stderr = process.communicate(timeout=30)
    assert process.returncode == 3
    assert "balance" not in stdout
    message = "error: another program uses the CoppeliaSim at .*, and stopped the simulation: .*\n$"
    assert re.search(rf"^{message}", stderr, re.MULTILINE)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("option", ["", "?engine=mujoco"])
def test_ctrl_c_ends_a_run_at_once_and_a_second_one_harms_nothing(address, other, tmp_path, option):
    out = tmp_path / "evaluation.json"
    with evaluating(address, out, option) as process:
        process.send_signal(signal.SIGINT)
        time.sleep(0.02)
        process.send_signal(signal.SIGINT)
        began = time.monotonic()
        _, stderr = process.communicate(timeout=30)
        assert time.monotonic() - began < 8.0  # a trial goes on for minutes
    assert process.returncode in (130, -signal.SIGINT)  # the interpreter ended, or was ended
    assert "Traceback" not in stderr
    assert "Assertion" not in stderr
    assert list(tmp_path.iterdir()) == []


def test_ctrl_c_while_the_scene_is_built_comes_after_it_and_leaves_nothing(
    address, other, monkeypatch
):
    built = []

    def build(*given):
        signal.raise_signal(signal.SIGINT)  # in a call it would leave an object without a name
        built.append(build_scene(*given))
        return built[0]

    monkeypatch.setattr("equipoise.apps.coppeliasim.rig.build_scene", build)
    with pytest.raises(KeyboardInterrupt):
        world_of(address)
    assert built


def test_one_driver_at_a_time_and_a_killed_one_is_replaced(address, other, tmp_path):
    own = watched(other)
    with evaluating(address, tmp_path / "evaluation.json") as process:
        message = f"^process {process.pid} on .* drives the CoppeliaSim"
        with pytest.raises(OutsideError, match=message):
            world_of(address)
        time.sleep(0.5)
        assert process.poll() is None
        assert is_running(other)
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert watched(other) != own
    assert is_running(other)
    world_of(address).rig.close()
    assert watched(other) == own
