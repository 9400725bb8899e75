"""Each fault ends as required; the list is complete, and the judge finds each wrong end."""

import numpy as np
import pytest

from equipoise.rig.config import RigSettings
from tests.conftest import tiers
from tests.faults.files import FILES
from tests.faults.table import TABLE
from tests.faults.verdicts import Sent, check_stop, problems_of

FAULTS = {fault.name: fault for fault in (*TABLE, *FILES)}
"""Faults that are injected in virtual time."""
QUICK = ("robot not following", "infinity in a setpoint", "TCP drop")
FULL = (
    "encoder unplugged in the self-test",
    "near singularity",
    "first command away from the measured pose",
)
"""Subsets: something of most kinds, and little to wait for."""
ARM = RigSettings().described_arm
HOME = np.array(ARM.home)


@pytest.mark.parametrize("name", tiers(FAULTS, QUICK, FULL))
def test_a_fault_ends_as_it_should(name):
    assert problems_of(FAULTS[name]) == []


# The judge, on courses written by hand: 5 ms apart, joint 1 moves.


def course(*speeds):
    """Setpoints that begin at home and move joint 1 at these speeds [rad/s]."""
    sent = [Sent(0.0, tuple(HOME))]
    for speed in speeds:
        q = np.array(sent[-1].q)
        q[0] += speed * 0.005
        sent.append(Sent(sent[-1].time + 0.005, tuple(q.tolist())))
    return sent


SLOWING = (0.4, 0.4, 0.4, 0.3, 0.2, 0.1, 0.0, 0.0)


@pytest.mark.parametrize(
    ("speeds", "saying"),
    [
        (SLOWING, None),
        ((*SLOWING, *(-0.1,) * 6, 0.0), None),  # a way back in the reach of the ramp
        ((0.4, 0.4, 0.4, 0.41, 0.2, 0.1, 0.0, 0.0), "no slower"),
        ((0.4, 0.4, 0.4, 0.3, 0.2, 0.25, 0.0, 0.0), "no slower"),
        ((0.4, 0.4, 0.4, 0.3, 0.2, 0.1, 0.0, 1.0), "sent away"),
        ((*SLOWING, *(-0.1,) * 40, 0.0), "left the reach"),
        ((0.4, 0.4, 0.4, 0.3, 0.2, 0.1), "still moves"),
        ((0.4, 0.4, 0.4), "no setpoint was sent"),
    ],
)
def test_a_stop_that_is_none_is_found(speeds, saying):
    # The stop is told with the fourth setpoint that moves.
    problems = check_stop(ARM, course(*speeds), 0.020)
    assert any(saying in problem for problem in problems) if saying else problems == []
