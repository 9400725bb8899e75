r"""Model of the operator's hand on the pendulum: grip, lift, hold with a tremor, release.

The hand follows its intended angle phi_h(t) exactly, and acts on the rod as a stiff spring and
damper

.. math:: \tau = s\, I\,(\omega^2 (\varphi_h - \varphi) + 2 \omega (\dot\varphi_h - \dot\varphi))

within the force of a hand; s falls from 1 to 0 while the fingers open. Angles are phi, from
upright, relative to the flange, and are not wrapped. A holding hand has a tremor: sines of 4 to
10 Hz and a slow drift. Its `HandParams` are drawn from a generator; equal generators give equal
hands.
"""

from math import cos, pi, radians, sqrt
from typing import Final, Literal, NamedTuple

import numpy as np

from equipoise.arrays import Array

Side = Literal["front", "back"]

STIFFNESS: Final = 200.0
"""Stiffness omega of a grip [rad/s]: it yields by w2 / omega^2, 0.1 deg, to a pendulum held
level."""
TONES: Final = 8
"""Number of sines in a tremor."""
PUSH_TIME: Final = 0.05
"""Duration of a push [s]."""


class HandParams(NamedTuple):
    """Parameters of one lift, hold and release."""

    side: Side
    """Whether the pendulum is lifted in front, through positive phi, or at the back."""
    lifting: float
    """Time from hanging to upright [s]."""
    holding: float
    """Duration of the hold upright [s]."""
    frequency: Array
    """Angular frequencies of tremor and drift [rad/s], shape (TONES + 2,)."""
    amplitude: Array
    """Their amplitudes [rad], likewise."""
    phase: Array
    """Their phases [rad], likewise."""
    opening: float
    """Opening time of the fingers [s]."""
    push: float
    """Change of rate at the release [rad/s]; zero for a clean one."""


def draw_hand_params(
    random: np.random.Generator, *, side: Side | None = None, clumsy: float = 0.25
) -> HandParams:
    """Draw the parameters of a hand at random.

    Args:
        random: The generator.
        side: Side of the lift (default: drawn).
        clumsy: Probability of a push or a drag at the release.
    """
    size = random.uniform(radians(0.05), radians(0.3))  # root mean square [rad]
    weights = random.uniform(0.5, 1.0, TONES)
    tremor = size * (weights / np.linalg.norm(weights)) * sqrt(2.0)
    drift = random.uniform(radians(0.1), radians(1.0)) * np.array([0.6, 0.4])
    drawn: Side = "front" if random.random() < 0.5 else "back"
    kind = random.random()
    pushes, drags = kind < 0.5 * clumsy, 0.5 * clumsy <= kind < clumsy
    opening = random.uniform(0.05, 0.4) if drags else random.uniform(0.005, 0.030)
    # After the largest push, 40/8.4 deg ahead, the pendulum could be caught.
    push = random.uniform(radians(5.0), radians(40.0)) * (1.0 if random.random() < 0.5 else -1.0)
    lifting, holding = random.uniform(1.5, 3.0), random.uniform(2.0, 20.0)
    tones, slow = random.uniform(4.0, 10.0, TONES), random.uniform(0.05, 0.3, 2)  # [Hz]
    return HandParams(
        side=side or drawn,
        lifting=lifting,
        holding=holding,
        frequency=2.0 * pi * np.r_[tones, slow],
        amplitude=np.r_[tremor, drift],
        phase=random.uniform(0.0, 2.0 * pi, TONES + 2),
        opening=opening,
        push=push if pushes else 0.0,
    )


class Hand:
    """Hand at the pendulum, over time."""

    def __init__(self, inertia: float, reach: float) -> None:
        """Start without contact.

        Args:
            inertia: Moment of inertia of the pendulum about its spindle [kg m^2].
            reach: Distance from the spindle to the grip [m].
        """
        self._inertia, self._most = inertia, 10.0 * reach  # assumed: a hand exerts up to 10 N
        self._manner: HandParams | None = None
        self._begin = self._from = self._to = 0.0
        self._opens: float | None = None
        self._pushes: list[tuple[float, float]] = []

    @property
    def holds(self) -> bool:
        """Whether the hand is on the pendulum, fingers closed."""
        return self._manner is not None and self._opens is None

    @property
    def idle(self) -> bool:
        """Whether the hand neither touches nor pushes the pendulum."""
        return self._manner is None and not self._pushes

    def lift(self, now: float, phi: float, manner: HandParams) -> None:
        """Grip the pendulum and bring it upright.

        Args:
            now: The time [s].
            phi: Angle of the pendulum relative to the flange, not wrapped [rad].
            manner: Parameters of the hand.
        """
        turns = np.floor(phi / (2.0 * pi)) if manner.side == "front" else np.ceil(phi / (2.0 * pi))
        self._grip(now, phi, 2.0 * pi * float(turns), manner)

    def steady(self, now: float, phi: float, manner: HandParams) -> None:
        """Grip the pendulum and bring it to hang, by the shorter way."""
        still = manner._replace(amplitude=np.zeros_like(manner.amplitude), push=0.0)
        self._grip(now, phi, _hanging(phi), still)

    def hold_deflected(self, now: float, phi: float, height: float, manner: HandParams) -> None:
        """Grip the pendulum and hold it deflected, for a free swing.

        Args:
            now: The time [s].
            phi: Angle of the pendulum relative to the flange [rad].
            height: Deflection from hanging [rad].
            manner: Parameters of the hand, with the side.
        """
        to = _hanging(phi) + (height if manner.side == "back" else -height)
        self._grip(now, phi, to, manner)

    def release(self, now: float) -> None:
        """Release the pendulum, with the parameters of this hold."""
        if self._manner is None or self._opens is not None:
            return
        self._opens = now
        if self._manner.push != 0.0:
            self.push(now, self._manner.push)

    def push(self, now: float, rate: float) -> None:
        """Push the pendulum, which changes the rate of a free pendulum [rad/s]."""
        self._pushes.append((now, rate))

    def torque(self, now: float, phi: float, phi_dot: float) -> float:
        """Return the torque of the hand on the pendulum in the next millisecond [N m].

        Args:
            now: The time [s].
            phi: Angle of the pendulum, relative to the flange [rad].
            phi_dot: Its rate [rad/s].
        """
        pull = 0.0
        if self._manner is not None:
            opens = now if self._opens is None else self._opens
            grip = 1.0 - (now - opens) / self._manner.opening
            if grip <= 0.0:
                self._manner = self._opens = None
            else:
                place, speed = self._place(now, self._manner)
                pull = grip * (STIFFNESS**2 * (place - phi) + 2.0 * STIFFNESS * (speed - phi_dot))
        if self._pushes:
            self._pushes = [push for push in self._pushes if now - push[0] < PUSH_TIME]
            for begin, rate in self._pushes:
                passed = max(now - begin, 0.0) / PUSH_TIME
                pull += rate / PUSH_TIME * (1.0 - cos(2.0 * pi * passed))
        return min(max(self._inertia * pull, -self._most), self._most)

    def _grip(self, now: float, phi: float, to: float, manner: HandParams) -> None:
        self._manner, self._opens = manner, None
        self._begin, self._from, self._to = now, phi, to

    def _place(self, now: float, manner: HandParams) -> tuple[float, float]:
        """Return the hand's angle [rad] and rate [rad/s]: minimum jerk, then still."""
        s = min(max((now - self._begin) / manner.lifting, 0.0), 1.0)
        way = s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
        speed = 30.0 * s**2 * (1.0 - s) ** 2 / manner.lifting
        tremor = manner.frequency * (now - self._begin) + manner.phase
        off = float(manner.amplitude @ np.sin(tremor))
        off_dot = float((manner.amplitude * manner.frequency) @ np.cos(tremor))
        distance = self._to - self._from
        rate = distance * speed + speed * off + way * off_dot
        return self._from + distance * way + way * off, rate


def _hanging(phi: float) -> float:
    """Return the hanging angle of the pendulum in its current turn [rad]."""
    return 2.0 * pi * round((phi - pi) / (2.0 * pi)) + pi
