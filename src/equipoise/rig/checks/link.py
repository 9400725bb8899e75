"""Round trips to a robot at rest, and the networks that may slow them."""

from collections.abc import Generator
from contextlib import contextmanager
from typing import Final

import numpy as np

from equipoise.rig.checks.results import SETPOINT_PERIOD, Array, CheckResult, Spread, rated
from equipoise.rig.interfaces import AngleSensor, Clock, Robot

GOOD_ROUND_TRIP: Final = 0.0055
"""99th percentile of round trips that allows two setpoints per tick of 10 ms [s]. Over a slower
link setpoints are sent only as replies arrive, and the flange's speed is limited."""
MAX_ROUND_TRIP: Final = 0.009
"""99th percentile of round trips beyond which a reply is overdue in every tick [s]."""


@contextmanager
def connected(device: Robot | AngleSensor) -> Generator[None]:
    """Connect a device for the duration of a block.

    Raises:
        LinkError: The device does not answer, or answers wrongly.
    """
    try:
        device.connect()
        yield
    finally:
        device.close()


def round_trips(
    robot: Robot, clock: Clock, seconds: float, *, period: float = SETPOINT_PERIOD
) -> Array:
    """Measure how long a connected robot at rest takes to return its joints [s], shape (n,).

    Args:
        robot: The robot; it does not move.
        clock: The rig's clock.
        seconds: Length of the measurement [s]; at least one round trip is measured.
        period: Time between two requests, where the reply has arrived by then [s].

    Raises:
        LinkError: The robot does not answer.
    """
    robot.measured()
    trips: list[float] = []
    begin = clock.now()
    for k in range(max(round(seconds / period), 1)):
        clock.wait_until(begin + k * period)
        asked = clock.now()
        if k and asked - begin >= seconds:
            break
        robot.measured()
        trips.append(clock.now() - asked)
    return np.array(trips)


def check_link(trips: Spread) -> CheckResult:
    """Judge the round trips to a robot."""
    slow = trips.p99 > GOOD_ROUND_TRIP
    return rated(
        "link to the robot",
        "bad" if trips.p99 > MAX_ROUND_TRIP else "warning" if slow else "good",
        trips.text(),
        "connect cabinet and computer by one direct cable, on a network card of their own (no USB "
        "adapter, no Wi-Fi), and switch other networks off; see docs/how-to/real-time.md",
        outside=True,
    )


def check_networks(networks: dict[str, bool] | None) -> CheckResult:
    """Judge which networks the machine is connected to, the robot being on one of them.

    Args:
        networks: Network cards in use, by name, and whether each is wireless; None where the system
            does not list them.
    """
    if not networks:
        cure = "make sure that only the robot's network is switched on"
        return CheckResult("networks", "unknown", "cannot be read here", cure)
    return rated(
        "networks",
        "warning" if len(networks) > 1 or any(networks.values()) else "good",
        ", ".join(f"{card}{' (wireless)' * wireless}" for card, wireless in networks.items()),
        "switch off all but the card with the robot's cable (`nmcli device disconnect ...`)",
    )
