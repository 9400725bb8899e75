"""Text for numbers of trials and runs."""

import numpy as np

from equipoise.outcomes import Outcome


def format_end(outcome: Outcome) -> str:
    """Return the end of a trial or a run as text."""
    return {
        Outcome.LASTED: "stood to the end",
        Outcome.ANGLE: "fell over",
        Outcome.TRACK: "left the track",
        Outcome.JOINT_LIMIT: "met a joint limit",
    }.get(outcome, f"ended by {outcome}")


def plus_minus(value: float, interval: tuple[float, float]) -> str:
    """Return a value with the half width of its interval, to two digits of the latter."""
    half = max(interval[1] - value, value - interval[0])
    if half <= 0.0:
        return f"{value:.4g}"
    digits = max(0, 1 - int(np.floor(np.log10(half))))
    return f"{value:.{digits}f} ± {half:.{digits}f}"
