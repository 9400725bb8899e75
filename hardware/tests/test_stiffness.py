"""The holder is stiff enough for the loop, by two estimates and against closed forms."""

import numpy as np
import pytest

import stiffness


def test_a_cube_resists_stretch_and_not_a_rigid_motion():
    nu = 0.3
    K = stiffness.cube(nu)
    corner = np.array([[i, j, k] for k in (0, 1) for j in (0, 1) for i in (0, 1)])
    assert pytest.approx(K.T) == K
    for direction in np.eye(3):
        assert np.abs(K @ np.tile(direction, 8)).max() < 1e-12
        turn = np.cross(direction, corner).ravel()
        assert np.abs(K @ turn).max() < 1e-12
    # Uniaxial stress with E = 1: energy 1/2 of strain squared times volume.
    stretch = (corner * [1.0, -nu, -nu]).ravel()
    assert stretch @ K @ stretch == pytest.approx(1.0)


def test_the_first_mode_is_far_above_the_loop(mechanism):
    first = stiffness.modes(mechanism)[0]
    assert first > 2.0 * stiffness.LEAST
    assert stiffness.beam(mechanism) > first  # a beam from the flange's edge on: stiffer


def test_the_spindle_is_stiffer_than_the_print(mechanism, design):
    assert stiffness.spindle(design, mechanism.pendulum.mass) > 500.0


def test_a_softer_print_lowers_the_modes_as_the_root_of_its_modulus(mechanism, design):
    soft = mechanism._replace(design=design._replace(print=design.print._replace(modulus=0.75e9)))
    ratio = stiffness.modes(mechanism, 6.0, 1) / stiffness.modes(soft, 6.0, 1)
    assert ratio[0] == pytest.approx(2**0.5, rel=0.02)
