"""What the tests of pictures share."""

import numpy as np
import pytest

from equipoise.errors import OutsideError
from equipoise.model.arms.iiwa import iiwa
from tests.apps.report.made_up import frames


@pytest.fixture(scope="session")
def canvas():
    """Skips where there is no OpenGL."""
    arm = iiwa(7)
    try:
        next(frames(arm, np.array([arm.home]), np.zeros(1), size=(32, 32)))
    except OutsideError as error:
        pytest.skip(str(error))
