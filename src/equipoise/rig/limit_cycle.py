"""Limit cycle of a balanced pendulum.

A policy with few accelerations, or a pivot with dry friction, keeps a pendulum swinging about
upright. The flange drifts meanwhile, slower and farther, so that period and amplitudes are those of
the strongest peak in the spectrum of phi.
"""

from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from equipoise.logs.run_log import RunLog

MIN_PERIODS: Final = 5.0
"""Minimum number of periods; fewer are a drift."""
MIN_SHARE: Final = 0.5
"""Minimum share of the peak in the power of phi; in the mean of a table's runs 0.8."""


class LimitCycle(NamedTuple):
    """Motion of a limit cycle."""

    period: float
    """Period [s]."""
    x: float
    """Amplitude of the flange [m]."""
    phi: float
    """Amplitude of the pendulum [rad]."""


def limit_cycle(run: RunLog) -> LimitCycle | None:
    """Return the limit cycle in the second half of a run; None without one.

    Args:
        run: Log of the run.
    """
    from scipy.signal import periodogram

    def spectrum(values: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        settled = values[len(values) // 2 :]
        return np.array(periodogram(settled, rate, "hann", 4 * len(settled), "linear"))

    rate = 1.0 / run.conditions.h
    frequency, phi = spectrum(run.estimated_phi)
    peak = float(frequency[np.argmax(phi)])
    near = (frequency > 0.8 * peak) & (frequency < 1.25 * peak)
    if peak * 0.5 * run.lasted < MIN_PERIODS or phi[near].sum() < MIN_SHARE * phi.sum():
        return None
    x = spectrum(run.x)[1]
    # The integral of the density is the mean square, half of the square of the amplitude.
    amplitudes = (float(np.sqrt(2.0 * one[near].sum() * frequency[1])) for one in (x, phi))
    return LimitCycle(1.0 / peak, *amplitudes)
