"""Checks of machine, links and policy before a run, for the pre-flight and the diagnosis.

A check judges one subject and returns its findings; a threshold stands beside its check and nowhere
else. The loop of the measurements is measured, too: a late loop finds every device late. Nothing
here moves an arm.
"""

from collections.abc import Callable, Generator, Sequence
from math import degrees, floor, inf
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Final, Literal, NamedTuple

import numpy as np

from equipoise.arm.arm import Arm
from equipoise.arrays import Array
from equipoise.control.controller import Controller
from equipoise.control.policy import TaskPolicy, tick_policy
from equipoise.control.swing_up import SwingUpPolicy, make_swing_up
from equipoise.errors import EquipoiseError, InputError, LinkError
from equipoise.identification.driven_swing import MODEL_STEP, driven_swing
from equipoise.model.actuator import Actuator
from equipoise.model.pendulum import PendulumParameters
from equipoise.outcomes import MAX_STALL
from equipoise.rig.clocks import DrainingClock, SystemClock
from equipoise.rig.config import RigSettings
from equipoise.rig.connection import Rig
from equipoise.rig.host import prepare
from equipoise.rig.interfaces import SETPOINT_PERIOD, AngleSensor, Clock, Robot
from equipoise.rig.request import TRIALS, RunRequest, judge_response, simulate_trials
from equipoise.rig.script import POLICY_TIME_FRACTION
from equipoise.settings import HANGING
from equipoise.user_code import user_code

STALL: Final = 0.020
"""Delay from which a loop, an encoder or a link counts as stalled [s]: two ticks. A robot that sets
the pace may then stop."""
GOOD_ROUND_TRIP: Final = 0.0055
"""99th percentile of round trips that allows two setpoints per tick of 10 ms [s]. Over a slower
link setpoints are sent only as replies arrive, and the flange's speed is limited."""
BAD_ROUND_TRIP: Final = 0.009
"""99th percentile of round trips beyond which a reply is overdue in every tick [s]."""


class Finding(NamedTuple):
    """Result of one check."""

    name: str
    """Subject of the check."""
    evidence: str
    """Measured values, and the limit where it is not met."""
    remedy: str
    """Action that helps."""
    warning: bool = False
    """Whether a warning is due, which goes into the log."""
    bad: bool = False
    """Whether a run is forbidden."""

    @property
    def status(self) -> Literal["good", "warning", "bad"]:
        """The result in a word."""
        return "bad" if self.bad else "warning" if self.warning else "good"

    @property
    def sentence(self) -> str:
        """The finding as a sentence for the operator."""
        text = f"{self.name}: {self.status}, {self.evidence}"
        return text if self.status == "good" else f"{text}; {self.remedy}"


def require(findings: Sequence[Finding], error: type[EquipoiseError] = InputError) -> None:
    """Raise an error that names every bad finding.

    Args:
        findings: The findings.
        error: Type of the error: `OutsideError` where the rig is at fault.

    Raises:
        EquipoiseError: A finding is bad.
    """
    bad = [f"{found.name}: {found.evidence}; {found.remedy}" for found in findings if found.bad]
    if bad:
        raise error("; ".join(bad))


def check_machine(granted: dict[str, str], paced: bool) -> list[Finding]:
    """Judge the real-time settings of a process, and the kernel below a robot that sets the pace.

    Args:
        granted: Results of the settings, see `equipoise.rig.host.prepare`; empty in virtual time.
        paced: Whether the robot sets the pace.
    """
    remedy = (
        "on Linux: sudo groupadd -f realtime; sudo usermod -aG realtime $USER; put `@realtime - "
        "rtprio 99` and `@realtime - memlock unlimited` into /etc/security/limits.conf; log in "
        "again"
    )
    findings = [
        Finding(name, how, remedy, warning=how != "granted") for name, how in granted.items()
    ]
    if paced and granted:
        realtime = Path("/sys/kernel/realtime").exists()
        kernel = f"{'with' if realtime else 'without'} PREEMPT_RT"
        remedy = (
            "install a kernel with PREEMPT_RT, see docs/how-to/real-time.md; expect lost packets"
        )
        findings.append(Finding("kernel", kernel, remedy, warning=not realtime))
    return findings


def check_deadlines(late: Array, *, paced: bool = False) -> Finding:
    """Judge how late deadlines are met, and whether a run outlasts the stalls.

    Args:
        late: Lateness of each deadline [s], shape (n,); that of a stall is its length.
        paced: Whether the robot sets the pace.
    """
    longest, limit = float(late.max()), STALL if paced else MAX_STALL
    # A fifth of the stream's period is far below the arm's delay.
    uneven = np.percentile(late, 99.0) > 0.2 * SETPOINT_PERIOD or longest > SETPOINT_PERIOD
    return Finding(
        "deadlines",
        f"late by {_spread(late)}; a run ends at {1e3 * limit:g} ms",
        "end other programs, set the governor, install a kernel with PREEMPT_RT; see "
        "docs/how-to/real-time.md; measure again with --seconds 60",
        warning=bool(uneven),
        bad=longest > limit,
    )


def check_link(trips: Array, *, paced: bool = False) -> Finding:
    """Judge the round trips to a robot, or the times between states of one that sets the pace.

    Args:
        trips: These times [s], shape (n,).
        paced: Whether the robot sets the pace.
    """
    p99 = float(np.percentile(trips, 99.0))
    if paced:
        return Finding(
            "link to the robot",
            f"a state each {_spread(trips)}; a run ends at {1e3 * STALL:g} ms",
            "use one direct cable and a network card of its own; see docs/how-to/real-time.md",
            warning=p99 > 2.0 * np.median(trips),
            bad=float(trips.max()) > STALL,
        )
    return Finding(
        "link to the robot",
        f"round trips of {_spread(trips)}; good below {1e3 * GOOD_ROUND_TRIP:g} ms",
        "connect robot and computer by one direct cable, on a network card of their own (no "
        "USB adapter, no Wi-Fi), and switch other networks off; see docs/how-to/real-time.md",
        warning=p99 > GOOD_ROUND_TRIP,
        bad=p99 > BAD_ROUND_TRIP,
    )


def check_encoder(
    rig: RigSettings | None,
    counts: int,
    rate: float,
    ages: Array,
    lost_fraction: float,
    illegal: int,
) -> list[Finding]:
    """Judge an encoder by its stream.

    Args:
        rig: Contents of `rig.toml`; None skips the comparison of the counts.
        counts: Counts per revolution after x4, as the board reports them.
        rate: Samples per second [1/s].
        ages: Age of the newest sample at each read [s], shape (n,).
        lost_fraction: Fraction of samples lost on the way, damaged or out of sequence [-].
        illegal: Number of samples with an illegal transition on the board.
    """
    age = float(np.percentile(ages, 99.0))
    expected = counts if rig is None else rig.counts_per_rev
    return [
        Finding(
            "encoder's counts",
            f"{counts} per revolution, expected {expected}",
            "correct counts_per_rev in rig.toml, or COUNTS_PER_REV in the firmware",
            bad=counts != expected,
        ),
        Finding(
            "encoder's samples",
            f"{rate:.0f} per second, the newest {1e3 * age:.1f} ms old",
            "use a faster board with native USB (Teensy, Pico); set an adapter's latency timer to "
            "1 ms: echo 1 | sudo tee /sys/bus/usb-serial/devices/ttyUSB0/latency_timer",
            # A board at 500 Hz reaches 450; five samples at 1 kHz.
            warning=rate < 450.0 or age > 0.005,
            bad=rate < 200.0 or age > STALL,
        ),
        Finding(
            "encoder's line",
            f"{lost_fraction:.2%} of the samples lost, {illegal} illegal transitions",
            "check the encoder's supply, screen, plugs and baud rate, and keep its cable away "
            "from the motors'",
            warning=lost_fraction > 0.01,
            bad=illegal > 0,
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
    evidence, same = f"{arm.name}, the policy is for {trained.name}", trained.digest == arm.digest
    if not same:
        evidence += ", whose joints differ in geometry or limits"
    elif not np.allclose(arm.home, trained.home, rtol=1e-5, atol=1e-6):  # six digits suffice
        same = False
        home, other = (
            [float(f"{degrees(q):g}") for q in described.home] for described in (arm, trained)
        )
        evidence = f"home_deg = {home}, the policy is for {other}"
    joint, margin = _nearest_limit(arm, arm.home)
    response, fits = judge_response(policy, actuator)
    return [
        Finding(
            "policy and arm",
            evidence,
            "train a policy for this arm and home, or correct rig.toml",
            bad=not same,
        ),
        Finding(
            "arm's response",
            response,
            "train with --actuator and the file that identify makes of this rig's excitation",
            bad=not fits,
        ),
        Finding(
            "encoder's resolution",
            f"{rig.counts_per_rev} counts, the policy's {plant.counts_per_rev}",
            "train with --set plant.counts_per_rev, or use a finer encoder",
            bad=rig.counts_per_rev < plant.counts_per_rev // 2,
        ),
        Finding(
            "home",
            f"{joint} is {margin:.1f} deg inside its limits",
            "choose a home further inside all limits",
            bad=margin < rig.position_margin_deg + 5.0,
        ),
    ]


def check_swing_up(request: RunRequest) -> Finding:
    """Simulate swing-ups of a run's pendulum and arm, within its limits.

    Raises:
        InputError: A swing-up cannot end with the policy.
        SettingsError: The pendulum is linearised.
    """
    policy, actuator, limit = request.policy, request.actuator, request.max_speed
    results = simulate_trials(policy, actuator, HANGING, 1.0, limit)  # [s]
    typical, longest = results.upright or (inf, inf)
    return Finding(
        "swing-up",
        f"{results.survived} of {TRIALS} succeed in simulation, after {typical:.1f} s (median), "
        f"{longest:.1f} s (maximum)",
        "use a shorter pendulum, raise --max-speed, or start by hand",
        warning=results.survived < TRIALS,
        bad=results.survived < TRIALS / 2,
    )


def max_flange_speed(
    arm: Arm, trips: Array, requested: float | None, rule: Callable[[Arm, float], float] | None
) -> float | None:
    """Return the flange's speed limit [m/s]; None where nothing limits it.

    Args:
        arm: The rig's arm, with its home posture.
        trips: Round trips to the robot [s], shape (n,).
        requested: Limit that the request sets [m/s]; None without one.
        rule: Rule of the robot for a slow link, see `RobotPlugin.flange_speed`.
    """
    p99 = float(np.percentile(trips, 99.0))
    if rule is None or p99 <= GOOD_ROUND_TRIP:
        return requested
    limit = floor(1e3 * rule(arm, p99)) / 1e3  # the log names this very number
    return min(limit, requested or inf)


def check_speed(policy: TaskPolicy, limit: float | None) -> list[Finding]:
    """Judge whether the policy was trained for the flange's speed limit [m/s]; None for none."""
    if limit is None:
        return []
    trained = policy.settings.plant.max_speed
    evidence = f"stops at {limit:.3g} m/s, trained for {trained or 'any speed'}"
    remedy = f"train --set plant.max_speed={limit:.3g} makes a policy that keeps the limit"
    return [Finding("flange speed", evidence, remedy, warning=trained is None or trained > limit)]


def check_posture(q: Array, rig: RigSettings) -> Finding:
    """Judge the distance of measured joints [rad], shape (joints,), from their limits."""
    joint, margin = _nearest_limit(rig.described_arm, q.tolist())
    remedy = f"move {joint} by hand to {rig.position_margin_deg:g} deg or more inside its limits"
    evidence = f"{joint} is {margin:.1f} deg inside its limits"
    return Finding("posture", evidence, remedy, bad=margin < rig.position_margin_deg)


def _spread(durations: Array) -> str:
    """Return median, 99th percentile and maximum of durations [s], in words."""
    p50, p99, most = (1e3 * np.percentile(durations, (50.0, 99.0, 100.0))).tolist()
    return f"{p50:.2f} ms (median), {p99:.2f} ms (99 %), {most:.2f} ms (maximum)"


def _nearest_limit(arm: Arm, q: Sequence[float]) -> tuple[str, float]:
    """Return the joint nearest to one of its limits, and the distance [deg]."""
    pairs = zip(arm.joints, q, strict=True)
    margins = [degrees(min(angle - joint.lower, joint.upper - angle)) for joint, angle in pairs]
    nearest = int(np.argmin(margins))
    return arm.joints[nearest].name, margins[nearest]


def preflight(
    request: RunRequest, rig: Rig, granted: dict[str, str]
) -> tuple[list[Finding], float | None]:
    """Check a connected rig, after `check_fit` of its description; nothing moves.

    A bad result refuses the run; a warning goes into the log.

    Args:
        request: The run.
        rig: The rig.
        granted: Real-time settings of the process; empty in virtual time.

    Returns:
        Result of each check, and flange speed at which the run stops [m/s]; None without a limit.

    Raises:
        LinkError: Robot or encoder does not answer.
    """
    policy, settings, seconds = request.policy, request.settings, 1.0  # of each measurement
    clock = TimedClock(rig.clock)
    waiting = DrainingClock(clock, rig.sensor)
    paced = rig.plugin.paced
    trips = round_trips(rig.robot, waiting, seconds, paced=paced)
    rule = rig.plugin.flange_speed
    max_speed = max_flange_speed(settings.described_arm, trips, request.max_speed, rule)
    results = [
        check_link(trips, paced=paced),
        *check_speed(policy, max_speed),
        check_posture(rig.robot.measured(), settings),
        *check_encoder(settings, *listen(rig.sensor, clock, seconds)),
        *check_machine(granted, paced),
    ]
    return [check_deadlines(np.array(clock.late), paced=paced), *results], max_speed


def examine(
    robot: Robot | None,
    sensor: AngleSensor | None,
    rig: RigSettings | None,
    seconds: float,
    *,
    paced: bool = False,
) -> list[Finding]:
    """Measure a machine and a rig, and judge the measurements; no arm moves.

    This thread keeps the real-time settings of a run's loop.

    Args:
        robot: The robot, not connected; None examines none.
        sensor: The encoder, not connected; None examines none.
        rig: Contents of `rig.toml`; None where they are unknown.
        seconds: Duration of each measurement [s].
        paced: Whether the robot sets the pace.
    """
    clock = TimedClock(SystemClock())
    machine, findings = check_machine(prepare(), paced), list[Finding]()
    begin = clock.now()
    for k in range(max(round(seconds / SETPOINT_PERIOD), 1)):
        clock.wait_until(begin + (k + 1) * SETPOINT_PERIOD)
    for device in (sensor, robot):
        if device is None:
            continue
        name = "encoder" if device is sensor else "robot"
        try:
            with user_code(f"the driver of the {name}"):
                device.connect()
                if isinstance(device, AngleSensor):
                    findings += check_encoder(rig, *listen(device, clock, seconds))
                else:
                    trips = round_trips(device, clock, seconds, paced=paced)
                    findings.append(check_link(trips, paced=paced))
        except LinkError as error:
            remedy = "check its power, its cable and its address"
            findings.append(Finding(name, str(error), remedy, bad=True))
        finally:
            device.close()
    return [*machine, check_deadlines(np.array(clock.late), paced=paced), *findings]


def warm_up(request: RunRequest) -> None:
    """Run all code of a tick and of the self-test's model, to compile it before the stream starts.

    The policy's part is timed.

    Raises:
        ArmError: Home is a singular posture.
        SettingsError: The delay exceeds the controller's history.
        InputError: The policy raises, returns no finite number, or takes too long.
    """
    settings, policy = request.settings, tick_policy(request.policy)
    arm = settings.described_arm
    params, _ = request.parameters(request.actuator)
    controller, took = Controller(arm, params, request.policy.settings.boxes), list[float]()
    policy.reset()
    for _ in range(20):
        controller.observe((0.0, 0.0), (arm.home, 0.0))
        began = perf_counter()
        u = controller.decide(policy)
        took.append(perf_counter() - began)
        _ = controller.box  # the log of a tick names it
        controller.command(u)
    controller.hold()  # a tick that was missed
    driven_swing(0.0, 0.0, np.zeros(1), MODEL_STEP, PendulumParameters(1.0, 1.0, 0.0))
    controller.pose(arm.home)
    if request.start == HANGING and (kernel := request.policy.kernel) is not None:
        SwingUpPolicy(kernel, make_swing_up(params, inf)).act(np.zeros(4))
    typical, limit = median(took), POLICY_TIME_FRACTION * request.policy.h
    if typical > limit:
        raise InputError(
            f"{request.policy.name} takes {1e3 * typical:.1f} ms, expected at most "
            f"{1e3 * limit:.1f} ms; make it faster"
        )


class TimedClock:
    """Clock that records how late its waits end."""

    def __init__(self, clock: Clock) -> None:
        """Wrap a clock."""
        self._clock = clock
        self.late: list[float] = []
        """Time from the end of each wait, or from its begin if that was later, to the return [s]:
        a slow device does not count."""

    def now(self) -> float:
        """Return the time [s]."""
        return self._clock.now()

    def wait_until(self, time: float) -> None:
        """Wait until a time [s]."""
        due = max(time, self.now())
        self._clock.wait_until(time)
        self.late.append(self.now() - due)


def round_trips(robot: Robot, clock: Clock, seconds: float, *, paced: bool = False) -> Array:
    """Measure how long a connected robot at rest takes to return its joints [s], shape (n,).

    It is asked once per setpoint, where its reply has arrived by then; a robot that sets the pace
    for each of its states.

    Args:
        robot: The robot; it does not move.
        clock: The rig's clock.
        seconds: Length of the measurement [s]; at least one round trip is measured.
        paced: Whether the robot sets the pace.

    Raises:
        LinkError: The robot does not answer.
    """
    robot.measured()
    trips: list[float] = []
    begin, period = clock.now(), 0.001 if paced else SETPOINT_PERIOD
    for k in range(max(round(seconds / period), 1)):
        clock.wait_until(begin + k * period)
        asked = clock.now()
        if k and asked - begin >= seconds:
            break
        robot.measured()
        trips.append(clock.now() - asked)
    return np.array(trips)


def listen(
    sensor: AngleSensor, clock: Clock, seconds: float
) -> tuple[int, float, Array, float, int]:
    """Measure the stream of a connected encoder; return the arguments of `check_encoder`.

    Args:
        sensor: The encoder.
        clock: The rig's clock.
        seconds: Length of the measurement [s].

    Raises:
        LinkError: The encoder is disconnected or silent.
    """
    for _ in _reads(clock, 0.1):
        sensor.samples()
    before, begin = sensor.rejected, clock.now()
    newest, received, missing, illegal = begin, 0, 0, 0
    ages: list[float] = []
    for _ in _reads(clock, seconds):
        samples, now = sensor.samples(), clock.now()
        for sample in samples:
            missing, illegal = missing + sample.missing, illegal + sample.illegal
            newest = sample.time
        received += len(samples)
        ages.append(now - newest)
    lost = missing + sensor.rejected - before
    rate = received / (clock.now() - begin)
    fraction = lost / max(received + lost, 1)
    return sensor.counts_per_rev, rate, np.array(ages), fraction, illegal


def _reads(clock: Clock, seconds: float) -> Generator[None]:
    """Yield once per read period."""
    begin = deadline = clock.now()
    while (now := clock.now()) < begin + seconds:
        deadline = max(deadline + 0.001, now)
        clock.wait_until(deadline)
        yield
