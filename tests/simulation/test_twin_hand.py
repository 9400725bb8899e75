"""The hand: how it lifts, holds and lets go."""

import numpy as np
import pytest

from tests.rig.in_process import PENDULUM, stand

UNSTABLE = np.sqrt(PENDULUM.w2)


def recorded(bench, clock, seconds):
    """phi in space, each millisecond [rad]."""
    angles = []
    for _ in range(round(1000 * seconds)):
        clock.wait_until(clock.now() + 0.001)
        angles.append(bench.twin.truth().phi)
    return np.array(angles)


@pytest.mark.compiled_only
@pytest.mark.parametrize(("side", "sign"), [("front", 1), ("back", -1)])
def test_it_lifts_from_its_side_and_holds_upright_within_its_tremor(side, sign):
    bench, clock = stand(seed=11)
    clock.wait_until(0.2)
    manner = bench.lift(side=side)
    lifting = recorded(bench, clock, manner.lifting)
    middle = lifting[len(lifting) // 4 : -len(lifting) // 4]
    assert (sign * middle > 0).all()
    held = recorded(bench, clock, 8.0)
    assert bench.hand.holds
    # Sum of all amplitudes, and the grip's yielding.
    assert np.abs(held).max() < manner.amplitude.sum() + np.radians(0.2)
    quick = held - np.convolve(held, np.ones(500) / 500, mode="same")
    rms = np.std(quick[500:-500])
    assert rms == pytest.approx(np.sqrt(np.sum(manner.amplitude[:-2] ** 2) / 2), rel=0.25)


@pytest.mark.compiled_only
def test_released_cleanly_it_falls_freely_and_no_force_remains():
    for seed in range(2):
        bench, clock = stand(seed=seed)
        manner = bench.lift(clumsy=0.0)
        clock.wait_until(manner.lifting + 2.0)
        before = bench.twin.truth()
        bench.let_go()
        clock.wait_until(clock.now() + manner.opening + 0.002)
        assert bench.hand.idle
        assert not bench.twin.data.xfrc_applied.any()
        after = bench.twin.truth()
        # Nothing was thrown: the rate is still that of a tremor, or of the fall from there.
        allowed = abs(before.phi_dot) + UNSTABLE**2 * 0.1 * manner.opening + np.radians(8)
        assert abs(after.phi_dot) < allowed
        clock.wait_until(clock.now() + 0.6)
        assert abs(bench.twin.truth().phi) > np.radians(1.0)
