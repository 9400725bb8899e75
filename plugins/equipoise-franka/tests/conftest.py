"""The tests of the core compile kernels and run each test in an empty folder; these do the same."""

from tests.conftest import *  # noqa: F403
from tests.conftest import _elsewhere, _interruptible  # noqa: F401

collect_ignore = ["franka_sim_rig.py"]  # needs packages of its own
