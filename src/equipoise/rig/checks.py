"""Checks of machine, links and policy before a run, for the diagnosis and the pre-flight.

Each function judges one subject and returns its findings; a threshold stands beside its check and
nowhere else. Nothing here moves an arm.
"""

import platform
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from functools import partial
from math import degrees, floor, inf
from pathlib import Path
from typing import Final, TypeVar

import numpy as np
import numpy.typing as npt

from equipoise.control.policy import TaskPolicy
from equipoise.errors import LinkError
from equipoise.executors import available_cores
from equipoise.model.actuator import Actuator
from equipoise.model.arms.arm import Arm
from equipoise.rig.clocks import SystemClock
from equipoise.rig.config import RigSettings
from equipoise.rig.findings import Finding, Values, find
from equipoise.rig.interfaces import SETPOINT_PERIOD, AngleSensor, Clock, ServoedArm
from equipoise.rig.probes import EncoderStream, lateness, listen, round_trips
from equipoise.rig.realtime import run_with_realtime_priority
from equipoise.safety.rules import MAX_STALL, T1_SPEED
from equipoise.user_code import guest_code

Array = npt.NDArray[np.float64]
D = TypeVar("D", ServoedArm, AngleSensor)
T = TypeVar("T")

MAX_LOAD_SHARE: Final = 0.5
"""Share of the cores at work before a run beyond which other programs compete with the loop [-]."""
MIN_FREE_SPACE: Final = 1 << 30
"""Free space for logs below which a day's runs may not fit [B]; a run of ten minutes writes tens of
megabytes."""
GOOD_LATENESS: Final = 0.001
"""99th percentile of the lateness of a good machine [s]: a fifth of the stream's period, far below
the arm's delay."""
STALL: Final = 0.020
"""Delay from which a loop, an encoder or a link counts as stalled [s]: two ticks."""
GOOD_ROUND_TRIP: Final = 0.0055
"""99th percentile of round trips that allows two setpoints per tick of 10 ms [s]. Over a slower
link setpoints are sent only as replies arrive, and the flange's speed is limited."""
MAX_ROUND_TRIP: Final = 0.009
"""99th percentile of round trips beyond which a reply is overdue in every tick [s]."""
MIN_SAMPLE_RATE: Final = 200.0
"""Rate below which ticks without a new sample are too frequent [1/s]."""
GOOD_SAMPLE_RATE: Final = 450.0
"""Rate that a board at 500 Hz reaches [1/s]."""
GOOD_SAMPLE_AGE: Final = 0.005
"""99th percentile of the newest sample's age on a good line [s]: five samples at 1 kHz."""
MAX_LOST_SHARE: Final = 0.01
"""Share of samples lost or rejected beyond which a wire is suspected [-]."""
HOME_TOLERANCE: Final = 1e-6
"""Difference of a joint's angle at home beyond which two homes differ [rad]."""
PIVOT_TOLERANCE: Final = 1e-3
"""Difference of the pivot's position on the flange beyond which a warning is given [m]."""
MIN_CLEARANCE_MM: Final = 50.0
"""Minimum clearance below the tip of the hanging pendulum [mm]."""
HOME_MARGIN_DEG: Final = 5.0
"""Minimum distance of home from a joint's limits, beyond the rig's margin [deg]."""


def examine(
    robot: ServoedArm | None,
    sensor: AngleSensor | None,
    rig: RigSettings | None,
    *,
    seconds: float,
    logs: Path,
    busy: Callable[[str], AbstractContextManager[object]],
) -> list[Finding]:
    """Measure a machine and a rig, and judge the measurements; the arm does not move.

    Args:
        robot: The robot, not connected; None examines none.
        sensor: The encoder, not connected; None examines none.
        rig: Contents of `rig.toml`; None where they are unknown.
        seconds: Duration of each measurement [s].
        logs: Folder of the run logs; it need not exist yet.
        busy: Shows the name of a measurement while its context is open.
    """
    with busy("measuring deadlines"):
        late, settings = run_with_realtime_priority(lambda: lateness(SystemClock(), seconds))
    findings = [*check_host(logs), *settings, *check_deadlines(late)]
    if sensor is not None:
        findings += _examine(
            "encoder", sensor, listen, lambda stream: check_encoder(stream, rig), seconds, busy
        )
    if robot is not None:
        findings += _examine("robot", robot, round_trips, check_link, seconds, busy)
    return findings


def _examine(
    name: str,
    device: D,
    measure: Callable[[D, Clock, float], T],
    check: Callable[[T], list[Finding]],
    seconds: float,
    busy: Callable[[str], AbstractContextManager[object]],
) -> list[Finding]:
    """Connect a device, measure it with the real-time settings of a run, and judge it."""
    try:
        with busy(f"measuring the {name}"), guest_code(f"the driver of the {name}"):
            device.connect()
            work = partial(measure, device, SystemClock(), seconds)
            return check(run_with_realtime_priority(work)[0])
    except LinkError as error:
        remedy = "check its power, its cable and its address"
        return [find(name, {"error": str(error)}, remedy, bad=True)]
    finally:
        device.close()


def check_host(logs: Path) -> list[Finding]:
    """Judge kernel, clock rate, cores, virtualisation, load, swap and disk of this machine.

    Args:
        logs: Folder of the run logs; it need not exist yet.
    """
    import psutil

    cores, load = available_cores(), psutil.getloadavg()[0]
    cpus, info = Path("/sys/devices/system/cpu"), Path("/proc/cpuinfo")
    files = cpus.glob("cpu[0-9]*/cpufreq/scaling_governor")
    governors = sorted({file.read_text().strip() for file in files}) or ["unknown"]
    virtual = (info.exists() and "hypervisor" in info.read_text()) or Path("/.dockerenv").exists()
    folder = next(one for one in (logs.absolute(), *logs.absolute().parents) if one.exists())
    swap, free = psutil.swap_memory().used, psutil.disk_usage(str(folder)).free
    return [
        find(
            "kernel",
            {"release": f"{platform.system()} {platform.release()} {platform.version()}"},
            "install Linux with PREEMPT_RT: on Ubuntu `sudo pro enable realtime-kernel`, on Debian "
            "`sudo apt install linux-image-rt-amd64`; then restart",
            warning="PREEMPT_RT" not in platform.version(),
        ),
        find(
            "clock rate",
            {"governor": " ".join(governors)},
            "sudo cpupower frequency-set -g performance; on a virtual machine set it at the host",
            warning=governors != ["performance"],
        ),
        find("cores", {"usable": cores}, "use a machine with two or more", warning=cores < 2),
        find(
            "bare machine",
            {"virtual": "yes" if virtual else "no"},
            "its host may stall it at any time: run on the machine itself; give a container "
            "--ulimit rtprio=99 --ulimit memlock=-1 --network host and the encoder's device",
            warning=virtual,
        ),
        find(
            "other work",
            {"processes_at_work": load},
            "find it with `top`, and end it; wait a minute and check again",
            warning=load > MAX_LOAD_SHARE * cores,
        ),
        find(
            "swap",
            {"used_MiB": swap >> 20},
            "memory is short: end other programs, then sudo swapoff -a",
            warning=swap > 0,
        ),
        find(
            "room for logs",
            {"free_MiB": free >> 20},
            "a full disk ends a log, not a run: make room, or give another folder",
            warning=free < MIN_FREE_SPACE,
        ),
    ]


def check_deadlines(late: Array) -> list[Finding]:
    """Judge how late deadlines are met, and whether a run outlasts the stalls.

    Args:
        late: Lateness of each deadline [s], shape (n,); the first one of a stall is its length.
    """
    stalled = late > STALL
    stalls = late[stalled & ~np.append(False, stalled[:-1])]
    longest = float(stalls.max(initial=0.0))
    uneven = np.percentile(late, 99.0) > GOOD_LATENESS or late.max() > SETPOINT_PERIOD
    return [
        find(
            "deadlines",
            _spread(late),
            "setpoints will come unevenly: end other programs, set the governor, allow real-time "
            "priority; measure again with --seconds 60",
            warning=bool(uneven),
        ),
        find(
            "stalls",
            {"number": len(stalls), "longest_ms": 1e3 * longest},
            f"a run ends at {1e3 * MAX_STALL:g} ms: end other programs, then follow the remedies "
            "above; measure again with --seconds 60",
            warning=len(stalls) > 0,
            bad=longest > MAX_STALL,
        ),
    ]


def check_link(trips: Array) -> list[Finding]:
    """Judge the round trips to a robot [s], shape (n,)."""
    p99 = float(np.percentile(trips, 99.0))
    return [
        find(
            "link to the robot",
            _spread(trips),
            "connect cabinet and computer by one direct cable, on a network card of their own (no "
            "USB adapter, no Wi-Fi), and switch other networks off; see docs/how-to/real-time.md",
            warning=p99 > GOOD_ROUND_TRIP,
            bad=p99 > MAX_ROUND_TRIP,
        )
    ]


def check_encoder(stream: EncoderStream, rig: RigSettings | None) -> list[Finding]:
    """Judge an encoder by its stream.

    Args:
        stream: Statistics of the stream.
        rig: Contents of `rig.toml`; None skips the comparison of the counts.
    """
    age, expected = float(np.percentile(stream.ages, 99.0)), rig and rig.counts_per_rev
    counts: Values = {"per_revolution": stream.counts_per_rev, "rig.toml": expected or "unknown"}
    return [
        find(
            "encoder's counts",
            counts,
            "correct counts_per_rev in rig.toml, or COUNTS_PER_REV in the firmware",
            bad=expected not in (None, stream.counts_per_rev),
        ),
        find(
            "encoder's samples",
            {"rate_Hz": stream.rate, "newest_p99_ms": 1e3 * age},
            "use a board with native USB (Teensy, Pico), or set the adapter's latency timer to "
            "1 ms: echo 1 | sudo tee /sys/bus/usb-serial/devices/ttyUSB0/latency_timer",
            warning=stream.rate < GOOD_SAMPLE_RATE or age > GOOD_SAMPLE_AGE,
            bad=stream.rate < MIN_SAMPLE_RATE or age > STALL,
        ),
        find(
            "encoder's line",
            {"lost_share": stream.lost_share},
            "change the cable, keep it away from the motors', and check the baud rate",
            warning=stream.lost_share > MAX_LOST_SHARE,
        ),
        find(
            "encoder's signals",
            {"illegal_transitions": stream.illegal},
            "counts are being lost: check the encoder's supply, screen and plugs, and keep its "
            "cable away from the motors'",
            bad=stream.illegal > 0,
        ),
    ]


def check_fit(policy: TaskPolicy, actuator: Actuator, rig: RigSettings) -> list[Finding]:
    """Judge a policy against the description of the rig of its run.

    Args:
        policy: The policy.
        actuator: Identified response of the rig's arm.
        rig: Contents of `rig.toml`.
    """
    arm, trained, plant = rig.described_arm, policy.arm, policy.settings.plant
    same_home = np.allclose(arm.home, trained.home, rtol=0.0, atol=HOME_TOLERANCE)
    pivot_error = float(np.abs(np.subtract(arm.pivot, trained.pivot)).max())
    fits = fitting_actuators(policy, actuator)
    nearest = policy.actuators[fits[0] if fits else 0]
    joint, room = _nearest_limit(arm, arm.home)
    findings = [
        find(
            "policy and arm",
            {"rig": arm.name, "policy": trained.name},
            "train a policy for this arm, or correct `arm` in rig.toml",
            bad=trained.digest != arm.digest,
        ),
        find(
            "policy and home",
            {"rig": _degrees(arm.home), "policy": _degrees(trained.home)},
            "give the home of the training in rig.toml, or train for this one",
            bad=trained.digest == arm.digest and not same_home,
        ),
        find(
            "pendulum's pivot",
            {"difference_mm": 1e3 * pivot_error},
            "the flange keeps its orientation, so that the motion is the same; measure the pivot "
            "again where it should be equal",
            warning=pivot_error > PIVOT_TOLERANCE,
        ),
        find(
            "arm's response",
            {
                "kind": actuator.kind,
                "delay_ms": 1e3 * actuator.delay.value,
                "trained_kind": nearest.kind,
                "trained_delay_ms": 1e3 * nearest.delay.value,
            },
            "train with --actuator and the file that identify makes of this rig's excitation",
            bad=not fits,
        ),
        find(
            "encoder's resolution",
            {"rig": rig.counts_per_rev, "policy": plant.counts_per_rev},
            "train with --set plant.counts_per_rev, or use a finer encoder",
            bad=rig.counts_per_rev < plant.counts_per_rev // 2,
        ),
        find(
            "home",
            {f"{joint}_inside_limit_deg": room},
            "choose a home further inside all limits",
            bad=room < rig.position_margin_deg + HOME_MARGIN_DEG,
        ),
    ]
    if rig.table_height_mm is not None:
        pose = arm.pose(arm.home_free)
        pivot = pose.position + pose.rotation @ np.array(arm.pivot)
        length = 1.5 * policy.pendulum.g / policy.pendulum.w2.value  # of a uniform rod
        below = 1e3 * float(pivot[2] - length) - rig.table_height_mm
        remedy = f"choose a home that leaves {MIN_CLEARANCE_MM:g} mm, or clear the table"
        low = below < MIN_CLEARANCE_MM
        findings.append(find("room below", {"clearance_mm": below}, remedy, bad=low))
    return findings


def fitting_actuators(policy: TaskPolicy, actuator: Actuator) -> list[int]:
    """Return the numbers of a policy's actuators that an identified one fits, from zero."""
    return [i for i, one in enumerate(policy.actuators) if _fits(policy, one, actuator)]


def _fits(policy: TaskPolicy, trained: Actuator, actuator: Actuator) -> bool:
    """Return whether delay, lags and response times are within the spread of the training."""
    plant = policy.settings.plant
    if plant.ideal or trained.kind == "ideal" or actuator.kind != trained.kind:
        return False
    pairs = zip(actuator.lags, trained.lags, strict=True)
    ratios = [one.value / other.value for one, other in pairs if other.value > 0.0]
    late = [actuator.delay.value - trained.delay.value]
    for joint in range(len(trained.lags)):
        late.append(actuator.response_time(joint) - trained.response_time(joint))
    slow = max(map(abs, late)) > plant.delay_spread
    return not slow and all(abs(ratio - 1.0) <= plant.lag_spread for ratio in ratios)


def max_flange_speed(
    arm: Arm, trips: Array, t1: bool, rule: Callable[[Arm, float], float] | None
) -> float:
    """Return the flange's speed limit [m/s]; inf where nothing limits it.

    Args:
        arm: The rig's arm, with its home posture.
        trips: Round trips to the robot [s], shape (n,).
        t1: Whether the limit of T1 holds.
        rule: Rule of the robot for a slow link, see `RobotPlugin.flange_speed`.
    """
    of_t1, p99 = T1_SPEED if t1 else inf, float(np.percentile(trips, 99.0))
    if rule is None or p99 <= GOOD_ROUND_TRIP:
        return of_t1
    return min(floor(1e3 * rule(arm, p99)) / 1e3, of_t1)  # the log names this very number


def check_speed(policy: TaskPolicy, limit: float) -> list[Finding]:
    """Judge whether the policy was trained for the flange's speed limit [m/s]; inf for none."""
    if limit == inf:
        return []
    trained = policy.settings.plant.max_speed
    values: Values = {"stops_at_mps": limit, "policy": trained or "any speed"}
    remedy = f"train --set plant.max_speed={limit:.3g} makes a policy that keeps the limit"
    return [find("flange speed", values, remedy, warning=trained is None or trained > limit)]


def check_posture(q: Array, rig: RigSettings) -> Finding:
    """Judge the distance of measured joints [rad], shape (joints,), from their limits."""
    joint, room = _nearest_limit(rig.described_arm, q.tolist())
    remedy = f"move {joint} by hand to {rig.position_margin_deg:g} deg or more inside its limits"
    values: Values = {f"{joint}_inside_limit_deg": room}
    return find("posture", values, remedy, bad=room < rig.position_margin_deg)


def _spread(durations: Array) -> Values:
    """Return the number of durations [s], and median, 99th percentile and maximum in ms."""
    names, shares = ("median_ms", "p99_ms", "max_ms"), (50.0, 99.0, 100.0)
    milliseconds = (1e3 * np.percentile(durations, shares)).tolist()
    return {"n": len(durations), **dict(zip(names, milliseconds, strict=True))}


def _nearest_limit(arm: Arm, q: Sequence[float]) -> tuple[str, float]:
    """Return the joint nearest to one of its limits, and the distance [deg]."""
    pairs = zip(arm.joints, q, strict=True)
    room = [degrees(min(angle - joint.lower, joint.upper - angle)) for joint, angle in pairs]
    nearest = int(np.argmin(room))
    return arm.joints[nearest].name, room[nearest]


def _degrees(q: Sequence[float]) -> str:
    return "(" + ", ".join(f"{degrees(angle):g}" for angle in q) + ")"
