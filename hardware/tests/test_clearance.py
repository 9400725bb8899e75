"""The pendulum turns wholly free of arm and table, at every place of the track."""

import numpy as np
import pytest
from scipy.optimize import minimize

import clearance
from checks import ARMS, MEDIA_FLANGES
from equipoise.arm.urdf import read_arm


@pytest.mark.parametrize("name", ARMS)
def test_the_whole_turn_is_clear_at_every_place_of_the_track(name, mechanism):
    for height in MEDIA_FLANGES if name.startswith("iiwa") else (0.0,):
        found = clearance.clearance(read_arm(name), mechanism, height)
        assert found.turn.shape == (23, 72)
        assert found.turn.min() >= clearance.LEAST
        assert found.table >= clearance.LEAST


@pytest.mark.parametrize("name", ARMS)
def test_the_holder_is_clear_of_the_links_before_the_flange(name, mechanism):
    assert clearance.clearance(read_arm(name), mechanism).holder > 0.0


def test_distances_of_segments_are_those_of_a_search():
    rng = np.random.default_rng(0)
    for _ in range(40):
        a0, a1, b0, b1 = rng.normal(size=(4, 3))

        def gap(st, a0=a0, a1=a1, b0=b0, b1=b1):
            return np.linalg.norm(a0 + st[0] * (a1 - a0) - b0 - st[1] * (b1 - b0))

        starts = [(0.1, 0.1), (0.9, 0.1), (0.1, 0.9), (0.9, 0.9)]
        best = min(minimize(gap, s, bounds=[(0, 1), (0, 1)], tol=1e-12).fun for s in starts)
        assert clearance.between_segments(a0, a1, b0[None], b1[None])[0] == pytest.approx(
            best, abs=1e-5
        )


def test_a_longer_pendulum_comes_nearer_to_the_table(mechanism):
    arm = read_arm("iiwa7")
    longer = mechanism._replace(rod_length=mechanism.rod_length + 100.0)
    near, far = (clearance.clearance(arm, one).table for one in (longer, mechanism))
    assert far - near == pytest.approx(0.1, abs=1e-3)


def test_a_pivot_inside_the_wrist_is_found(mechanism):
    close = mechanism._replace(design=mechanism.design._replace(pivot_outward=40.0))
    assert clearance.clearance(read_arm("iiwa7"), close).turn.min() < 0.0
