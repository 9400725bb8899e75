"""Figures and the HTML report, drawn from saved artefacts and values.

Figures are made without pyplot, so the backend that `MPLBACKEND` names has no effect on them. But
importing matplotlib fails if that backend does not exist. Therefore matplotlib is imported with
`MPLBACKEND` unset, and the backend is set afterwards if matplotlib accepts it.
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
