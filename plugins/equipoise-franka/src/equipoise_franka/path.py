r"""Path between setpoints of half a tick, for an arm that requests a command every millisecond.

The path is a quadratic B-spline over the setpoints :math:`q_k`. In one period T it leads from the
middle of :math:`q_{k-1} q_k` to the middle of :math:`q_k q_{k+1}`, with :math:`0 \le s < 1`:

.. math:: 2 q(s) = (1 - s)^2 q_{k-1} + (1 + 2 s - 2 s^2) q_k + s^2 q_{k+1}

Its velocity runs linearly from :math:`(q_k - q_{k-1}) / T` to :math:`(q_{k+1} - q_k) / T`, and its
acceleration is :math:`(q_{k+1} - 2 q_k + q_{k-1}) / T^2`. These are the differences that the guard
checks (`equipoise.rig.guarded`). While setpoints come in time, no point between them is
therefore further out, faster or more accelerated than the checked setpoints. The price is a
constant delay of T / 2 + `MARGIN`, which an identification of the arm contains.
"""

from collections import deque
from math import inf
from typing import Final

from equipoise.arrays import Array

MARGIN: Final = 0.001
"""Lateness of a setpoint that does not change the path [s]; a tick computes for 0.3 ms."""
LATE_FRACTION: Final = 0.5
"""Maximum further lateness of a setpoint that still bends the present part of the path, as a
fraction of a period [-]. The path then jumps by at most half its square of the step to that
setpoint. A later setpoint waits for the next part, before which the arm comes to rest."""


class SetpointPath:
    """Path of the joints; without new setpoints it rests at the last one."""

    def __init__(self, q: Array, period: float) -> None:
        """Begin at rest.

        Args:
            q: The joints [rad], shape (joints,).
            period: Time between two setpoints [s].
        """
        self._period, self._begin = period, -inf  # of the present part of the path
        self._knots = deque([q] * 3, maxlen=3)
        self._next_knots: deque[Array] = deque()
        self._at_end = True  # whether the present part ends at the last setpoint

    @property
    def started(self) -> bool:
        """Whether it has a setpoint."""
        return self._begin > -inf

    @property
    def end(self) -> Array:
        """Last knot of the present part [rad], shape (joints,)."""
        return self._knots[2]

    def add(self, setpoint: Array, now: float) -> None:
        """Add a setpoint of all joints [rad], shape (joints,), at a time [s]."""
        self._advance(now)
        since = now - self._begin
        if self._at_end and since >= self._period:  # the path rests, and starts again
            self._knots.extend([self.end] * 3)
            self._begin = now + MARGIN - self._period
        if self._at_end and since <= LATE_FRACTION * self._period:
            self._knots[2], self._at_end = setpoint, False  # bends the present part
        else:
            self._next_knots.append(setpoint)

    def at(self, time: float) -> Array:
        """Return the joints at a time [rad], shape (joints,); times do not decrease."""
        self._advance(time)
        s = min(max((time - self._begin) / self._period, 0.0), 1.0)
        a, b, c = self._knots
        return 0.5 * ((1.0 - s) ** 2 * a + (1.0 + 2.0 * s - 2.0 * s * s) * b + s * s * c)

    def _advance(self, time: float) -> None:
        """Advance to the part of the path at a time [s]."""
        while time >= self._begin + self._period and not (self._at_end and not self._next_knots):
            self._at_end = not self._next_knots
            self._knots.append(self.end if self._at_end else self._next_knots.popleft())
            self._begin += self._period
