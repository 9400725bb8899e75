"""Text for numbers of trials and runs."""

from collections.abc import Mapping
from typing import Final

import numpy as np

from equipoise.control.grid import CAUSES

LASTED: Final = CAUSES[0]
"""Cause of the end of a successful trial."""


def format_end(cause: str) -> str:
    """Return the end of a trial or a run as text."""
    return {
        LASTED: "stood to the end",
        "angle": "fell over",
        "track": "left the track",
        "joint limit": "met a joint limit",
        "guard": "was stopped by a guard",
    }.get(cause, cause)


def format_failures(causes: Mapping[str, int]) -> str:
    """Return the numbers of failed trials by cause as text."""
    failed = [f"{n} {format_end(cause)}" for cause, n in causes.items() if cause != LASTED]
    return ", ".join(sorted(failed)) or "none failed"


def percent(share: float) -> str:
    """Return a share as a percentage; a share below 1 never rounds up to 100 %."""
    text = f"{100.0 * share:.1f}"
    if text == "100.0" and share < 1.0:
        text = ">99.9"
    return f"{text.removesuffix('.0')} %"


def plus_minus(value: float, interval: tuple[float, float]) -> str:
    """Return a value with the half width of its interval, to two digits of the latter."""
    half = max(interval[1] - value, value - interval[0])
    if half <= 0.0:
        return f"{value:.4g}"
    digits = max(0, 1 - int(np.floor(np.log10(half))))
    return f"{value:.{digits}f} ± {half:.{digits}f}"
