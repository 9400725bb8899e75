"""Figures and the page: drawn from saved artefacts and values, by nobody else's help.

Figures are made without pyplot, so the backend that `MPLBACKEND` names has no effect on them. But
matplotlib cannot be imported where there is no such backend: it is imported without, and takes the
backend afterwards where it knows it.
"""

import os
import sys
from contextlib import suppress

if os.environ.get("MPLBACKEND") and "matplotlib" not in sys.modules:
    _backend = os.environ.pop("MPLBACKEND")
    try:
        import matplotlib
    finally:
        os.environ["MPLBACKEND"] = _backend
    with suppress(ValueError):
        matplotlib.rcParams["backend"] = _backend
