"""Table of the faults in virtual time: injection, trigger, and the required end of the run.

The whole of `equipoise deploy` runs on an emulated rig with one fault (`harness`). Faults of files
and of the date are in `files`.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from math import degrees, inf, nan, pi, radians, remainder
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np

from equipoise import bind_policy, paper
from equipoise.arm.arm import Joint
from equipoise.arm.posture import condition
from equipoise.control.control_step import SETPOINTS_PER_TICK
from equipoise.control.ticks import TickInputs
from equipoise.outcomes import Outcome
from equipoise.rig.config import RigSettings
from equipoise.simulation.twin.hand import draw_hand_params
from tests.faults.harness import START, FaultHarness, Scenario, Trigger

BALANCING = Trigger("balancing", 0.5)
"""Default trigger: half a second after the start of the balancing."""
AT_START = Trigger(START)
"""Trigger before the run begins."""

PERIOD = paper.STEP / SETPOINTS_PER_TICK
"""Time between two setpoints [s]."""

Inject = Callable[[FaultHarness], object]
Setpoint = tuple[float, ...]


class Fault(NamedTuple):
    """A fault, and the required end of its run."""

    name: str
    ends: frozenset[Outcome] = frozenset()  # permitted; `ERROR` for a run that must not begin
    inject: Inject = lambda harness: None
    trigger: Trigger = BALANCING
    scenario: Callable[[Scenario], Scenario] = lambda scenario: scenario
    within: float = inf  # maximum time from the fault to the stop [s]
    stoppable: bool = True  # whether software can still stop the arm
    says: str = ""  # what a message to the operator has to contain
    check: Callable[[FaultHarness], Sequence[str]] = lambda harness: ()  # returns more problems
    held_at_start: bool = False  # whether the policy may begin while the hand holds the pendulum
    words_after_stop: bool = True  # whether lines are typed after the stop, which end a way back


def _ends(*outcomes: str) -> frozenset[Outcome]:
    return frozenset(map(Outcome, outcomes))


FELL = _ends("angle", "track", "flange speed")
"""Ends of a balance without a true measurement: the arm stops on its track."""


def _change(part: str, **values: Any) -> Inject:
    """Set attributes of a part of the harness."""

    def inject(harness: FaultHarness) -> None:
        for name, value in values.items():
            setattr(attrgetter(part)(harness), name, value)

    return inject


def _call(method: str, *arguments: Any) -> Inject:
    """Call a method of a part of the harness."""
    return lambda harness: attrgetter(method)(harness)(*arguments)


def _with(**changes: Any) -> Callable[[Scenario], Scenario]:
    return lambda scenario: replace(scenario, **changes)


STALL = 0.060
"""Duration of a stall that is bridged [s]."""


def hold_back(harness: FaultHarness, part: str) -> None:
    """Hold back all bytes of the link to `robot` or `sensor` for a stall, then pass them on."""
    link = getattr(harness, part).link
    ends = [(end, end.delay) for end in (link, link.other)]

    def delay(since: float) -> None:
        for end, usual in ends:
            end.delay = max(usual, STALL - since)

    harness.each(delay)


# The encoder.


def _told(name: str, times: int) -> Callable[[FaultHarness], Sequence[str]]:
    """Return a check that the operator has received a message so many times."""

    def check(harness: FaultHarness) -> Sequence[str]:
        found = [message.name for message in harness.messages].count(name)
        return () if found == times else (f"{name} came {found} times, expected {times}",)

    return check


def _slip_slowly(harness: FaultHarness) -> None:
    """Turn the encoder by 1 deg on its spindle, slowly enough for any plausibility."""
    harness.each(lambda since: harness.bench.slip(radians(0.005)) if since < 0.2 else None)


def _count_other(turned: Callable[[float], float]) -> Inject:
    """Let the board count another angle instead of that of the spindle."""

    def inject(harness: FaultHarness) -> None:
        angle = harness.board.angle
        harness.board.angle = lambda: turned(angle())

    return inject


def _freeze(harness: FaultHarness) -> None:
    theta = harness.board.angle()
    harness.board.angle = lambda: theta


def _lose_counts(harness: FaultHarness) -> None:
    """Lose a twentieth of the upward counts."""
    lost, before = 0.0, harness.board.angle()

    def less(theta: float) -> float:
        nonlocal lost, before
        lost, before = lost + 0.05 * max(theta - before, 0.0), theta
        return theta - lost

    _count_other(less)(harness)


def _lose_lines(count: float) -> Inject:
    """Lose the next lines."""

    def inject(harness: FaultHarness) -> None:
        left = count

        def damage(data: bytes) -> bytes:
            nonlocal left
            lines = data.splitlines(keepends=True)
            kept = lines[int(min(left, len(lines))) :]
            left -= len(lines) - len(kept)
            return b"".join(kept)

        harness.encoder_tap.damage = damage

    return inject


def _malform(harness: FaultHarness) -> None:
    """Change or lose bytes of one line in fifty."""
    rng = np.random.default_rng(0)

    def damage(line: bytes) -> bytes:
        if rng.random() > 0.02:
            return line
        begin, count = int(rng.integers(len(line))), 1 + int(rng.integers(8))
        end = min(begin + count, len(line))
        lost = rng.random() < 0.5
        return line[:begin] + (b"" if lost else rng.bytes(end - begin)) + line[end:]

    harness.encoder_tap.damage = lambda data: b"".join(map(damage, data.splitlines(keepends=True)))


# fmt: off
ENCODER = (
    Fault("encoder unplugged", _ends("encoder lost"), _call("sensor.link.close"),
          within=0.02, says="encoder"),
    Fault("encoder unplugged in the self-test", _ends("encoder lost"),
          _call("sensor.link.close"), Trigger("swing", 0.7), within=0.02, says="encoder"),
    Fault("encoder silent", _ends("stale encoder"), _lose_lines(inf), within=0.09,
          says="its cable"),
    Fault("encoder frozen", FELL | _ends("count jump"), _freeze, within=2.0),
    Fault("encoder frozen before the self-test", _ends("self-test"), _freeze, Trigger("swing")),
    Fault("count jump", _ends("count jump", "encoder gap", "encoder lost"),
          _call("bench.slip", radians(5.0)), within=0.02),
    Fault("slow count loss", FELL | _ends("survived"), _lose_counts,
          Trigger("balancing"), _with(duration=8.0)),
    Fault("wrong sign", _ends("self-test"), _change("board", sign=-1), AT_START, says="sign"),
    Fault("wrong counts: half", _ends("self-test"), _count_other(lambda theta: 0.5 * theta),
          AT_START, says="counts"),
    Fault("wrong counts: x 1.1", _ends("self-test"), _count_other(lambda theta: 1.1 * theta),
          AT_START, says="counts"),
    Fault("board of another encoder", _ends("error"), _change("board", counts_per_rev=4096),
          AT_START, says="4096"),
    Fault("zeroed while swinging", _ends("count jump", "encoder gap", "encoder lost"),
          lambda harness: harness.bench.slip(-harness.bench.theta), Trigger("swing", 1.4),
          within=0.03),
    Fault("zero error", _ends("survived"), _slip_slowly, Trigger("swing"), check=_told("swing", 2)),
    Fault("zero error while balancing", FELL | _ends("survived"), _slip_slowly),
    Fault("stale samples", _ends("stale encoder"), _change("sensor.link", delay=0.1),
          within=0.09, says="old"),
    Fault("late samples at the release", FELL | _ends("survived", "encoder lost"),
          _change("sensor.link", delay=0.047), Trigger("armed")),
    Fault("stall of the encoder", _ends("survived"), lambda harness: hold_back(harness, "sensor")),
    Fault("malformed lines", _ends("encoder gap"), _malform, within=0.5, says="missing"),
    Fault("one lost line", _ends("survived"), _lose_lines(1), says="was lost"),
    Fault("lost lines", _ends("encoder gap"), _lose_lines(3), within=0.03),
    Fault("illegal transition", _ends("illegal transition"), _change("board", illegal=True),
          within=0.03, says="wiring"),
    Fault("board restarts", _ends("stale encoder", "encoder gap", "encoder lost"),
          _call("board.reboot"), within=0.09),
)
# fmt: on


# Time.


def _stall(*times: float) -> Inject:
    # Waits alternate: one for a tick, one for the setpoint in its middle. A late one for a tick is
    # followed by another, for the next tick.
    return lambda harness: harness.clock.stalls.extend(times)


# fmt: off
TIME = (
    Fault("late tick", _ends("late tick"), _stall(0.09), within=0.11),
    Fault("stall of the loop", _ends("survived"), _stall(0.06), says="loop stalled"),
    Fault("repeated stalls", _ends("repeated stalls"),
          _stall(*(3 * (0.03, *(9 * (0.0,))))), within=0.3, says="at last the loop"),
    Fault("one late tick", _ends("survived"), _stall(0.008)),
    Fault("late ticks", _ends("repeated stalls"), _stall(*(3 * (0.012, 0.0, 0.0))), within=0.08),
)
# fmt: on


# The robot and its link.


def _half_open(harness: FaultHarness) -> None:
    harness.robot.link.cut = harness.robot.link.other.cut = True


def _back_up(harness: FaultHarness) -> None:
    there = harness.robot.link.other
    before, there.delay = there.delay, 0.09
    harness.after(0.1, lambda: setattr(there, "delay", before))


def stall_shortly(harness: FaultHarness) -> None:
    """Let round trips take 25 ms for 15 ms, every 80 ms."""
    link = harness.robot.link
    ends, usual = (link, link.other), link.delay

    def delay(since: float) -> None:
        for end in ends:
            end.delay = max(usual, 0.0125) if since % 0.08 < 0.015 else usual

    harness.each(delay)


def _touch(force: float) -> Inject:
    """Press on the flange along the track for 0.3 s [N]."""

    def inject(harness: FaultHarness) -> None:
        harness.bench.touch((force, 0.0, 0.0))
        harness.after(0.3, lambda: harness.bench.touch((0.0, 0.0, 0.0)))

    return inject


def _no_bytes_after(harness: FaultHarness) -> Sequence[str]:
    fault = harness.injected_at or 0.0
    late = [time for time, _ in harness.robot_tap.sent if time > fault + 0.02]
    if harness.robot_tap.opened != 1:
        return (f"{harness.robot_tap.opened} connections were made",)
    return (f"{len(late)} lines were sent after the drop",) if late else ()


def _pushing(scenario: Scenario) -> Scenario:
    """Return a scenario whose policy pushes one way only."""
    own = scenario.policy
    parts = {name: getattr(own, name) for name in ("pendulum", "arm", "actuator", "settings")}
    return replace(scenario, policy=bind_policy(lambda _: paper.ACTIONS[0], **parts))


def _singular(scenario: Scenario) -> Scenario:
    """Return a scenario with an almost singular home: the worst of some random postures."""
    arm = scenario.settings.described_arm
    ranges = np.array([(joint.lower, joint.upper) for joint in arm.free_joints])
    lower, upper = np.clip(ranges, -pi, pi).T
    postures = np.random.default_rng(0).uniform(lower, upper, (300, len(ranges)))
    worst = arm.with_held(max(list(postures), key=lambda q: condition(arm, q)))
    return _at_home(scenario, np.degrees(worst).tolist())


def _at_home(scenario: Scenario, home_deg: Sequence[float]) -> Scenario:
    return replace(scenario, settings=RigSettings(home_deg=tuple(home_deg)))


def _setpoint(change: Callable[[Setpoint, float], Setpoint]) -> Inject:
    """Change each setpoint, given the time since the fault [s]."""
    return lambda harness: setattr(harness, "change_setpoint", change)


def _joint(place: int, value: Callable[[Joint, float, float], float]) -> Inject:
    """Change one joint of each setpoint, given its limits, angle and the time since the fault."""

    def inject(harness: FaultHarness) -> None:
        joint = harness.scenario.settings.described_arm.joints[place]

        def change(q: Setpoint, since: float) -> Setpoint:
            changed = list(q)
            changed[place] = value(joint, q[place], since)
            return tuple(changed)

        harness.change_setpoint = change

    return inject


def _creep(row: int) -> Inject:
    """Let the joints creep by 0.02 rad/s, in the directions that add up in one row of the twist."""

    def inject(harness: FaultHarness) -> None:
        arm = harness.scenario.settings.described_arm
        part = arm.kinematics(arm.home_free).jacobian[row]
        rates = np.zeros(len(arm.joints))
        rates[list(arm.free)] = np.where(np.abs(part) > 0.1, 0.02 * np.sign(part), 0.0)
        harness.change_setpoint = lambda q, since: tuple((q + rates * since).tolist())

    return inject


def _held_back(
    name: str, outcome: str, inject: Inject, says: str = "", trigger: Trigger = BALANCING
) -> Fault:
    """Return a fault of a setpoint, which the safety rules hold back."""
    return Fault(name, _ends(outcome), inject, trigger, within=0.03, says=says)


MOVED_AWAY = _ends("following error", "flange drift", "flange tilt", "track")
"""Ends of a run whose setpoints leave the planned motion."""

HANGING = _with(start="hanging")
SERIES = _with(start="hanging", runs=2, duration=0.5)
MOVES = {
    "homing": (Trigger("homing", 0.5), _with()),
    "self-test": (Trigger("swing", 0.6), _with()),
    "excitation": (Trigger("excitation", 1.0), _with(identify=True)),
    "swinging up": (Trigger("swing-up", 1.0), HANGING),
    "damping": (Trigger("damping", 0.3), SERIES),
    "balancing": (BALANCING, _with()),
}
"""Phases in which the arm moves: a time in each, and the scenario that reaches it."""


def run_off(joint: int, rate: float, most: float) -> Inject:
    """Let replies report a joint as running off at a rate [rad/s], at most so far [rad]."""

    def inject(harness: FaultHarness) -> None:
        begin = harness.clock.now()

        def run_away(reply: Any) -> Any:
            if reply.q is None:
                return reply
            since = max(0.5 * (reply.sent + reply.received) - begin, 0.0)
            away = np.zeros(len(reply.q))
            away[joint] = np.clip(rate * since, -most, most)
            return reply._replace(q=tuple((np.array(reply.q) + away).tolist()))

        change_replies(run_away)(harness)

    return inject


def slow_link(round_trip: float) -> Inject:
    """Let every later round trip to the robot take a duration [s]."""

    def inject(harness: FaultHarness) -> None:
        link = harness.robot.link
        link.delay = link.other.delay = max(0.5 * round_trip, link.delay)

    return inject


def _stop_behind_slow_link(harness: FaultHarness) -> None:
    slow_link(0.030)(harness)
    harness.bench.body.stop("emergency stop")


# fmt: off
ROBOT = (
    Fault("TCP drop", _ends("link lost"), _call("robot.link.close"), stoppable=False, within=0.02,
          check=_no_bytes_after),
    Fault("half-open link", _ends("link lost"), _half_open, stoppable=False, within=0.1),
    Fault("command backlog", _ends("link overdue"), _back_up, within=0.1, says="has not answered"),
    Fault("stall of the link", _ends("survived"), lambda harness: hold_back(harness, "robot"),
          says="link stalled"),
    Fault("short stalls of the link", _ends("repeated stalls"), stall_shortly, within=0.2,
          says="at last the robot's link"),
    Fault("nak", _ends("link lost"),
          _change("robot_tap", damage=lambda data: b"nak\n" * data.count(b"\n")),
          stoppable=False, within=0.03),
    Fault("robot not following", _ends("robot not following", "following error"),
          _call("bench.body.stop", "the drives' protection"), Trigger("homing", 0.4), within=0.4),
    Fault("E-stop", _ends("robot not following", "following error", "angle"),
          _call("bench.body.stop", "emergency stop"), within=0.4),
    Fault("E-stop before the release", _ends("robot not following", "following error", "angle"),
          _call("bench.body.stop", "emergency stop"), Trigger("armed")),
    Fault("mode change", _ends("robot not following", "following error"),
          _call("bench.body.stop", "change of the operating mode"), Trigger("swing", 0.5),
          within=0.5),
    Fault("contact", _ends("contact"), _touch(60.0), within=0.1, says="touches the arm"),
    Fault("contact on the way home", _ends("contact"), _touch(150.0), Trigger("homing", 0.3),
          within=0.1),
    _held_back("joint limit", "joint position",
               _joint(1, lambda joint, q, since: joint.upper - radians(1.5)), "joint 2"),
    _held_back("velocity limit", "joint velocity",
               _joint(-1, lambda joint, q, since: q + 1.3 * joint.velocity * PERIOD),
               "rad/s, expected"),
    _held_back("acceleration limit", "joint acceleration",
               _joint(-1, lambda joint, q, since: q + 1.5 * joint.acceleration * since**2),
               "rad/s^2, expected")._replace(within=0.04),
    Fault("runaway", MOVED_AWAY, _joint(-1, lambda joint, q, since: q + 2.5 * since**2),
          within=0.4),
    Fault("track limit", _ends("track", "angle"), scenario=_pushing, trigger=Trigger("balancing"),
          within=1.0),
    Fault("flange too fast", _ends("flange speed"), _call("bench.push", 1.0),
          scenario=_with(max_speed=0.23), within=0.5, says="0.23 m/s"),
    Fault("near singularity", _ends("error"), trigger=AT_START, scenario=_singular, says="home"),
    Fault("flange drift", _ends("flange drift"), _creep(2), within=3.0, says="off its line"),
    Fault("flange pitch error", _ends("flange tilt", "flange drift"), _creep(3), within=3.0),
    Fault("first command away from the measured pose", _ends("first setpoint"),
          _setpoint(lambda q, since: tuple(angle + 0.02 for angle in q)), AT_START,
          says="first setpoint"),
    _held_back("unit slip in the setpoints", "joint position",
               _setpoint(lambda q, since: tuple(map(degrees, q)))),
    *(Fault(f"joints run off: {phase}", MOVED_AWAY, run_off(0, 10.0, 1.5), trigger,
            scenario, within=0.08, says="not plausible", words_after_stop=False)
      for phase, (trigger, scenario) in MOVES.items()),
    *(Fault(f"slow link: {phase}", _ends("stale joints", "repeated stalls", "arm not identified"),
            _stop_behind_slow_link, trigger, scenario, within=0.135, says="link",
            words_after_stop=phase != "damping")
      for phase, (trigger, scenario) in MOVES.items()),
)
# fmt: on


# Invalid numbers.


def _inputs(change: Callable[[TickInputs], TickInputs]) -> Inject:
    def inject(harness: FaultHarness) -> None:
        before = harness.change_inputs
        harness.change_inputs = lambda inputs: change(before(inputs))

    return inject


def _nan_times(inputs: TickInputs) -> TickInputs:
    samples: Sequence[Any] = inputs.samples
    return inputs._replace(samples=[sample._replace(time=nan) for sample in samples])


def change_replies(change: Callable[[Any], Any]) -> Inject:
    return _inputs(lambda inputs: inputs._replace(replies=list(map(change, inputs.replies))))


def freeze_joints(harness: FaultHarness) -> None:
    """Let every later reply repeat the first joints."""
    first: list[Setpoint] = []

    def repeat(reply: Any) -> Any:
        first.extend([reply.q] if reply.q and not first else [])
        return reply._replace(q=first[0]) if reply.q else reply

    change_replies(repeat)(harness)


def _nan_replies(column: str) -> Inject:
    """Replace all numbers of a column of the robot's replies by NaN."""

    def spoiled(reply: Any) -> Any:
        values = getattr(reply, column)
        return reply if values is None else reply._replace(**{column: (nan,) * len(values)})

    return change_replies(spoiled)


def _damage(wire: str, line: bytes) -> Inject:
    """Replace all bytes that a wire receives by a line."""
    return _change(wire, damage=lambda data: data and line)


# fmt: off
NUMBERS = (
    Fault("NaN from the encoder's line", _ends("stale encoder", "encoder gap", "encoder lost"),
          _damage("encoder_tap", b"E,nan,nan,nan,0*00\n"), within=0.09),
    Fault("NaN from the robot's line", _ends("link lost"),
          _damage("robot_tap", b"_".join(7 * [b"NaN"]) + b"\n"), stoppable=False, within=0.03),
    Fault("NaN in a sample's time", _ends("not a number"), _inputs(_nan_times), within=0.02),
    Fault("NaN in measured joints", _ends("not a number"), _nan_replies("q"), within=0.02),
    Fault("NaN in torques", _ends("not a number"), _nan_replies("torque"), within=0.08),
    _held_back("NaN in a setpoint", "not a number", _joint(0, lambda joint, q, since: nan),
               "finite"),
    _held_back("infinity in a setpoint", "not a number", _joint(2, lambda joint, q, since: inf),
               "finite", Trigger("homing", 0.3)),
    _held_back("six numbers in a setpoint", "wrong count", _setpoint(lambda q, since: q[:6]), "7"),
    Fault("controller fails", _ends("fault"),
          _inputs(lambda inputs: inputs._replace(samples=[None])), within=0.03,
          says="a part of the run failed"),
)
# fmt: on


# The release.


def _let_go_in_mid_lift(harness: FaultHarness) -> None:
    bench = harness.bench

    def drop(_: float) -> None:
        from_upright = abs(remainder(bench.phi, 2.0 * pi))
        if bench.hand.holds and abs(from_upright - radians(40.0)) < radians(2.0):
            bench.let_go()

    harness.each(drop)
    harness.after(9.0, lambda: harness.typed.append("stop"))


def _take_away(duration: float) -> Inject:
    """Hold the pendulum for 4 s, then lead it down within a duration [s]."""

    def inject(harness: FaultHarness) -> None:
        hand = draw_hand_params(np.random.default_rng(0), clumsy=0.0)._replace(lifting=duration)
        bench = harness.bench
        harness.after(4.0, lambda: bench.hand.steady(bench.now, bench.phi, hand))
        harness.after(9.0, lambda: harness.typed.append("stop"))

    return inject


ARMING_MISSED = _with(missed_messages=frozenset({"armed", "disarmed", "nudge"}))
"""Scenario in which the emulated operator misses that the controller is armed."""

# fmt: off
RELEASE = (
    Fault("release too early", _ends("operator"), _let_go_in_mid_lift, Trigger("lift"),
          check=_told("balancing", 0)),
    Fault("release too late", _ends("operator"), _take_away(0.8), Trigger("armed"), ARMING_MISSED,
          check=_told("balancing", 0), says="still holding"),
    Fault("hand that falls with the pendulum", FELL | _ends("operator"), _take_away(2.5),
          Trigger("armed"), ARMING_MISSED, held_at_start=True),
    Fault("push", FELL | _ends("survived"), _call("bench.push", radians(20.0))),
    Fault("hard push", FELL | _ends("count jump"), _call("bench.push", radians(250.0)),
          within=0.6),
)
# fmt: on


# Without a hand.


HOLD = _call("bench.steady")
"""Holds the pendulum down from now on, as an obstacle does."""
SWUNG_ONCE = _told("swing-up", 1)

# fmt: off
IN_SWING_UP = Trigger("swing-up", 2.0)
HANDS_OFF = (
    Fault("encoder unplugged in the swing-up", _ends("encoder lost"), _call("sensor.link.close"),
          IN_SWING_UP, HANGING, within=0.02, says="encoder"),
    Fault("encoder frozen in the swing-up", _ends("not upright", "self-test", "count jump"),
          _freeze, IN_SWING_UP, HANGING),
    Fault("E-stop in the swing-up", _ends("robot not following", "following error"),
          _call("bench.body.stop", "emergency stop"), IN_SWING_UP, HANGING, within=0.4),
    Fault("contact in the swing-up", _ends("contact"), _touch(60.0), IN_SWING_UP, HANGING,
          within=0.1),
    Fault("stall in the swing-up", _ends("survived"), _stall(0.06), IN_SWING_UP, HANGING,
          says="loop stalled"),
    Fault("push in the swing-up", _ends("survived"), _call("bench.push", radians(200.0)),
          IN_SWING_UP, HANGING),
    Fault("pendulum held in the swing-up", _ends("not upright", "self-test"), HOLD, IN_SWING_UP,
          HANGING),
    Fault("pendulum held between two runs", _ends("self-test"), HOLD, Trigger("stopping", 3.0),
          SERIES, check=SWUNG_ONCE, words_after_stop=False),
    Fault("zero that slips between two runs", _ends("self-test"), _call("bench.slip", radians(1.0)),
          Trigger("stopping", 2.0), SERIES, says="hangs", check=SWUNG_ONCE,
          words_after_stop=False),
    Fault("robot lost between two runs", _ends("error"), _call("robot.link.close"),
          Trigger("stopping", 2.0), SERIES, check=SWUNG_ONCE, words_after_stop=False),
    Fault("key between two runs", _ends("operator"), _call("typed.append", "stop"),
          Trigger("stopping", 2.5), SERIES, check=SWUNG_ONCE, words_after_stop=False),
    Fault("key after a stop of a series", _ends("survived"), scenario=SERIES,
          trigger=Trigger("stopping"), check=SWUNG_ONCE),
)
# fmt: on


# The operator and the input files.


def _other_arm(scenario: Scenario) -> Scenario:
    name = scenario.settings.described_arm.name
    return replace(scenario, settings=RigSettings(arm="iiwa7" if name == "iiwa14" else "iiwa14"))


# fmt: off
KEYS = {"homing": 0.5, "hang": 1.0, "swing": 0.6,
               "lift": 1.5, "armed": 0.1, "damping": 0.5, "swing-up": 1.0, "balancing": 1.0}
"""Time of a key press in each phase, after its start [s]."""
SCENARIOS = {"damping": SERIES, "swing-up": HANGING}
OPERATOR = (
    *(Fault(f"key: {phase}", _ends("operator"), _call("typed.append", "stop"),
            Trigger(phase, after), SCENARIOS.get(phase, _with()), within=0.02, says="operator",
            words_after_stop=False)
      for phase, after in KEYS.items()),
)
INPUTS = (
    Fault("policy of another rig", _ends("error"), trigger=AT_START, scenario=_other_arm,
          says="policy and arm"),
    Fault("unit slip", _ends("error"), trigger=AT_START, says="home",
          scenario=lambda base: _at_home(base, base.settings.described_arm.home)),
)
# fmt: on

TABLE = (*ENCODER, *TIME, *ROBOT, *NUMBERS, *RELEASE, *HANDS_OFF, *OPERATOR, *INPUTS)
