"""Types of NumPy arrays."""

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
"""Numbers; the docstring of each function gives the shape."""
IntArray = npt.NDArray[np.int64]
"""Whole numbers, such as indices and counts."""
