"""The environment on an emulated rig: the course of a run, its guards, and rest at its end."""

import itertools
import multiprocessing
import sys
import time
from threading import Thread

import gymnasium as gym
import numpy as np
import pytest

import equipoise.envs  # noqa: F401  (registers the environments)
from equipoise.control.policy import shipped_policy
from equipoise.envs.rig import _Handover, _RemotePolicy
from equipoise.errors import InputError, OutsideError
from equipoise.logs.run_log import RunLog
from tests.cli.test_emulate import emulator

pytestmark = pytest.mark.compiled_only


def make(robot="twin:nominal", **arguments):
    return gym.make("equipoise/Balance-v0", world="rig", robot=robot, **arguments)


def test_a_table_balances_until_the_time_limit_and_equal_seeds_give_equal_bits():
    policy, runs = shipped_policy(), []
    env = make(duration=2.0)
    for _ in range(2):
        observation, info = env.reset(seed=1)
        assert info["cause"] == ""
        bits, ended = [observation.tobytes()], False
        while not ended:
            observation, _, terminated, truncated, info = env.step([policy.act(observation)])
            bits.append(observation.tobytes())
            ended = terminated or truncated
        assert (terminated, truncated, info["cause"]) == (False, True, "lasted")
        assert info["time"] == pytest.approx(2.0)
        runs.append(bits)
    assert runs[0] == runs[1]
    env.close()


def test_a_guard_ends_the_episode_with_its_cause_and_close_brings_the_arm_to_rest(tmp_path):
    env = make(log=tmp_path / "run.mcap")
    env.reset(seed=2)
    terminated = False
    while not terminated:
        _, reward, terminated, truncated, info = env.step(np.array([2.0]))
        assert not truncated
    assert info["cause"] == "angle"
    assert reward == -1.0
    env.reset(seed=3)
    for _ in range(10):
        env.step(np.array([0.0]))
    episode = env.unwrapped._rig
    assert episode._thread.is_alive()
    end = episode.end()
    assert (end.cause, episode._thread) == ("operator", None)
    env.close()
    assert (tmp_path / "run.mcap").stat().st_size > 1000


def test_what_does_not_belong_to_a_rig_is_refused():
    for arguments in ({"observe": "raw"}, {"render_mode": "rgb_array"}):
        with pytest.raises(InputError, match="needs robot="):
            make(**arguments)
    with pytest.raises(InputError, match="a run on a robot is logged"):
        gym.make("equipoise/Balance-v0", world="rig", robot="kst://host", encoder="socket://h:1")
    with pytest.raises(InputError, match="belong to world='rig'"):
        gym.make("equipoise/Balance-v0", world="model", robot="twin:nominal")


class Yes:
    """Operator who confirms every question."""

    def __init__(self):
        self.answers = []

    def notify(self, event):
        self.answers += event.answers[:1]

    def read_input(self):
        answers, self.answers = self.answers, []
        return answers


def late_at(tick, rig, folder):
    """Balance in real time until an action is late; return the last tick and info."""
    policy = shipped_policy()
    env = make(
        robot=f"kst://127.0.0.1:{rig.port}",
        encoder=f"serial://{rig.terminal}",
        log=folder / "run.mcap",
        operator=Yes(),
    )
    try:
        observation, _ = env.reset()
    except OutsideError as error:
        return -1, {"cause": str(error)}
    for i in itertools.count():
        if i == tick:
            time.sleep(0.1)
        observation, _, ended, truncated, info = env.step([policy.act(observation)])
        if ended or truncated:
            env.close()
            return i, info


def test_a_policy_in_another_process_receives_u_through_the_pipe():
    handover, (ours, theirs) = _Handover(None), multiprocessing.Pipe()
    served = Thread(target=handover.serve, args=(ours,), daemon=True)
    served.start()
    policy, observation = _RemotePolicy(theirs), np.arange(4.0)
    policy.reset()
    assert policy.act(observation) == 0.0  # the warm-up
    assert handover.observations.empty()
    policy.reset()
    handover.actions.put(1.5)
    assert policy.act(observation) == 1.5
    assert np.array_equal(handover.observations.get(), observation)
    theirs.close()
    served.join(5.0)
    assert not served.is_alive()


@pytest.mark.skipif(sys.platform == "win32", reason="a rig needs Linux")
def test_a_missing_rig_is_one_error_of_reset_and_leaves_no_log(tmp_path):
    log = tmp_path / "run.mcap"
    absent = {"robot": "kst://127.0.0.1:1", "encoder": "serial:///dev/nowhere", "log": log}
    env = make(**absent, operator=Yes())
    with pytest.raises(OutsideError, match="/dev/nowhere"):
        env.reset()
    env.close()
    assert not log.exists()


@pytest.mark.slow  # in real time: only an idle machine answers each observation within 5 ms
@pytest.mark.skipif(sys.platform == "win32", reason="there are no pseudo-terminals")
def test_over_wires_in_real_time_it_balances_until_an_action_is_late(tmp_path):
    for attempt in range(3):  # a host that stalls ends a run earlier
        (folder := tmp_path / str(attempt)).mkdir()
        with emulator() as rig:
            last, info = late_at(50, rig, folder)
        if last == 50:
            break
    assert (last, info["cause"]) == (50, "policy"), info
    assert "took" in info["reason"]
    assert RunLog.load(folder / "run.mcap").cause == "policy"
