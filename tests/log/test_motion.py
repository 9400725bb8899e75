"""Motion of a run: measured on a rig, true in simulation, at any time."""

from dataclasses import replace

import numpy as np
import pytest

from equipoise import excite
from equipoise.errors import InputError, RecordingError
from equipoise.log.motion import Motion
from tests.log.made_up import (
    RELEASE,
    balanced_on_a_rig,
    changed_table,
    phi_on_a_rig,
    short_run,
    x_on_a_rig,
)


@pytest.fixture(scope="module")
def run():
    run = balanced_on_a_rig()
    q = np.tile(run.conditions.arm.home, (901, 1)) + np.linspace(0.0, 0.9, 901)[:, None]
    return changed_table(run, "tick", q=q, late=np.full(901, 2e-4))


def test_a_rig_is_shown_as_it_was_measured(run):
    motion, arm = Motion.of(run), run.conditions.arm
    assert motion.part() == pytest.approx((-2.0, 3.01))
    for time, phase, u in ((-3.0, "lifting", 0.0), (0.3, "balancing", 1.5), (2.5, "stopping", 0.0)):
        now = motion.at(time)
        assert now.x == pytest.approx(x_on_a_rig(RELEASE + time), abs=5e-5)
        assert now.phi == pytest.approx(phi_on_a_rig(RELEASE + time), abs=6e-4)
        x = arm.kinematics(arm.without_held(now.q)).position[0]
        home = arm.kinematics(arm.home_free).position[0]
        assert x == pytest.approx(home + now.x, abs=1e-5)
        assert (now.phase, now.u, now.late) == (phase, u, 2e-4)


def test_a_simulated_run_is_shown_as_it_truly_was():
    run = short_run()
    motion = Motion.of(run)
    now = motion.at(0.105)
    np.testing.assert_allclose(now.q, 0.5 * (run.truth.q[10] + run.truth.q[11]))
    assert now.phi == pytest.approx(0.5 * (run.truth.phi[10] + run.truth.phi[11]))
    assert (now.u, now.phase) == (run.ticks.u[10], "balancing")
    assert np.isnan(now.late)
    assert motion.part() == pytest.approx((0.0, 0.4))


def test_a_part_is_inside_the_run(run):
    motion = Motion.of(run)
    assert motion.part(-4.0, None) == pytest.approx((-4.0, 3.01))
    for begin, end in ((-6.5, 0.0), (0.0, 3.5), (1.0, 0.5), (np.nan, 1.0), (0.0, np.inf)):
        with pytest.raises(InputError):
            motion.part(begin, end)


def test_a_hanging_pendulum_does_not_jump_between_pi_and_its_opposite():
    run = balanced_on_a_rig()
    time = run.tables["encoder"]["time"]
    swinging = np.pi * np.clip(7.0 - time, 0.0, 1.0)
    swinging += 0.1 * np.sin(3.0 * time) * np.clip(6.0 - time, 0.0, 1.0)
    counts = np.round(123.0 + (np.pi - swinging) * 8192 / (2.0 * np.pi))
    motion = Motion.of(changed_table(run, "encoder", time=time, counts=counts))
    assert np.max(np.abs(np.diff(motion.phi))) < 0.05
    assert motion.at(0.0).phi == pytest.approx(0.0, abs=1e-3)
    assert 3.0 < abs(motion.at(-4.0).phi) <= np.pi


def test_a_run_with_nothing_to_show_is_refused(run):
    excited = excite("iiwa7", duration=0.2)
    tables = dict(run.tables) | {"tick": run.tables["tick"][:0]}
    time = run.tables["tick"]["time"].copy()
    time[300] = 3.0
    for nothing in (excited, replace(run, tables=tables), changed_table(run, "tick", time=time)):
        with pytest.raises(RecordingError):
            Motion.of(nothing)
