"""Refine: what logs of the twin say about pendulum and actuator, and which table is kept.

The twin is MuJoCo's, and the logs show what its sensors show. Its pendulum varies from run to run
by 2 %, and that is found, too; so where nothing shall have moved, this variation is switched off.
"""

import functools
from dataclasses import replace

import numpy as np
import pytest

from equipoise import Actuator, Estimate, iiwa, shipped_policy, simulate_run
from equipoise.errors import ArtefactError, RecordingError
from equipoise.identification.refine import inspect
from equipoise.model.worlds import TwinSettings, World
from tests.log.made_up import changed_table

ACTUATOR = Actuator.assumed("kst", delay=0.010, lag=0.008)
"""The nominal twin's, as its numbers say."""


@functools.cache
def run(seed, factor=1.0, duration=20.0, **numbers):
    """A log of the shipped policy on a twin whose w2 is not what the policy believes.

    The controller of the run predicts with the true w2: a standing policy is what is wanted here.
    """
    policy, known = shipped_policy(), shipped_policy().pendulum
    w2, k = (Estimate.around(factor * one.value, 0.0, "given") for one in (known.w2, known.k))
    there = policy.model_copy(update={"pendulum": known.model_copy(update={"w2": w2, "k": k})})
    twin = TwinSettings(inertia_sigma=0.0, friction_sigma=0.0, **numbers)
    return simulate_run(there, world=World("twin:steady", twin), seed=seed, duration=duration)


def policy_knowing(actuator=ACTUATOR):
    return shipped_policy().model_copy(update={"actuator": actuator})


# What is read from a log


def test_unusable_logs_are_refused_and_an_arm_at_rest_tells_no_actuator():
    policy, log = shipped_policy(), run(2)
    bare = log.conditions.model_copy(update={"counts_per_rev": None})
    with pytest.raises(RecordingError, match="a rig"):
        inspect(policy, replace(log, conditions=bare))
    # Its joints have the same names.
    elsewhere = policy.model_copy(update={"arm": iiwa(14)})
    with pytest.raises(ArtefactError):
        inspect(elsewhere, log)
    posture = np.broadcast_to(log.stream.q[0], log.stream.q.shape)
    found = inspect(policy_knowing(), changed_table(log, "stream", q=posture))
    assert found.response == {}
    assert any("actuator" in warning for warning in found.warnings)


# The pendulum


def test_what_moved_makes_another_pendulum():
    weighed = Estimate.normal(0.2, 0.001, "given")
    policy = policy_knowing()
    known = policy.pendulum.model_copy(update={"mass": weighed, "inertia": weighed})
    policy = policy.model_copy(update={"pendulum": known})
    found = inspect(policy, run(7, 1.1))
    assert list(found.moves) == ["w2"]
    there = found.pendulum
    assert (there.w2, there.k, there.c) == (found.fit.w2, found.fit.k, known.c)
    assert there.w2.value == pytest.approx(1.1 * known.w2.value, rel=0.01)
    assert (there.mass, there.inertia) == (None, None)
    half = there.w2.value - there.w2.low
    assert there.covariance[0][0] == pytest.approx((half / 1.96) ** 2, rel=0.5)
    assert there.covariance[0][1:] == (0.0, 0.0, 0.0)
    # The arm is the same, and nothing of it changes.
    assert found.actuator == policy.actuator


# The actuator


def test_the_same_arm_is_the_same_actuator_as_far_as_it_moves():
    found = inspect(policy_knowing(), run(2))
    assert found.response["delay"].value == pytest.approx(0.010, abs=0.001)
    assert found.response["lag of A1"].value == pytest.approx(0.008, rel=0.2)
    # The wrist holds the flange level, and hardly moves for it.
    assert "lag of A5" not in found.response
    assert found.moves == {}
    assert found.pendulum == shipped_policy().pendulum
    assert found.actuator == ACTUATOR


@pytest.mark.full
@pytest.mark.parametrize(
    ("numbers", "name", "truth"),
    [({"transport": 0.018}, "delay", 0.018), ({"lag": 0.016}, "lag of A1", 0.016)],
)
def test_an_arm_that_follows_otherwise_is_found(numbers, name, truth):
    found = inspect(policy_knowing(), run(2, **numbers))
    assert name in found.moves
    assert found.response[name].value == pytest.approx(truth, rel=0.1)
    assert found.pendulum == shipped_policy().pendulum
    assert found.actuator.delay == found.response["delay"]
    assert found.actuator.lags[0] == found.response["lag of A1"]
    # What the log does not tell stays as it was.
    assert found.actuator.lags[3] == ACTUATOR.lags[3]
    assert Actuator.model_validate(found.actuator.model_dump()) == found.actuator
