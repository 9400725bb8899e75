"""The fault list: what goes wrong, when, and how it has to end.

A fault that lives in a socket, a port, a process or the machine's clock cannot be shown where time
is virtual; those stand in `equipoise.studies.rehearsal.real_time`.
"""

from collections.abc import Callable, Sequence
from math import degrees, inf, nan, pi, radians, remainder
from typing import Any, Final, NamedTuple

import numpy as np

from equipoise.control.safety import Rule
from equipoise.control.ticks import TickInputs
from equipoise.devices.kuka.server_emulator import Faults
from equipoise.devices.twin.hand import draw_hand_params
from equipoise.studies.rehearsal.fault_harness import (
    START,
    FaultHarness,
    Scenario,
    Setpoint,
    Trigger,
    on,
)

BALANCING: Final = Trigger("balancing", 0.5)
"""In the middle of a balance."""
AT_START: Final = Trigger(START)

Inject = Callable[[FaultHarness], None]


def nothing(stage: FaultHarness) -> None:
    """Break nothing: it was broken before the run began."""


def unchanged(scene: Scenario) -> Scenario:
    """Return a scene as it is."""
    return scene


class Fault(NamedTuple):
    """A line of the list."""

    name: str
    """As the list calls it."""
    kind: str
    """What it is a fault of."""
    injected: str
    """What goes wrong, and when."""
    should: str
    """What has to happen."""
    ends: frozenset[str]
    """Causes of which the run names one; `refused` where it must not begin."""
    inject: Inject = nothing
    """Makes it go wrong."""
    moment: Trigger = BALANCING
    """When."""
    scene: Callable[[Scenario], Scenario] = unchanged
    """What is wrong from the start."""
    within: float | None = None
    """From the fault to the stop [s]; none where the fault shows only by what comes of it."""
    stoppable: bool = True
    """Whether software can stop the arm."""
    says: str = ""
    """What the operator reads."""
    check: Callable[[FaultHarness], Sequence[str]] = lambda stage: ()
    """What else has to be so; returns what is not."""
    held_at_start: bool = False
    """Whether the policy may begin while a hand still holds the pendulum."""
    play: Callable[[], list[str]] | None = None
    """Where no run is needed: makes it happen, and returns what did not end as it should."""


def _ends(*causes: str | Rule) -> frozenset[str]:
    return frozenset(cause.value if isinstance(cause, Rule) else cause for cause in causes)


FELL: Final = _ends(Rule.ANGLE, Rule.TRACK, Rule.SPEED)
"""A balance that ends since nothing tells what really is; the arm is stopped on its track."""


# The encoder.


def _unplug(stage: FaultHarness) -> None:
    stage.parts.encoder_link.close()


def _silence(stage: FaultHarness) -> None:
    stage.parts.board.silent = True


def _freeze(stage: FaultHarness) -> None:
    stage.parts.board.frozen = True


def _lose_counts(stage: FaultHarness) -> None:
    stage.parts.board.loss = 0.05


def _wrong_sign(stage: FaultHarness) -> None:
    stage.parts.board.sign = -1


def _half_counts(stage: FaultHarness) -> None:
    stage.parts.board.factor = 0.5


def _more_counts(stage: FaultHarness) -> None:
    stage.parts.board.factor = 1.1


def _other_board(stage: FaultHarness) -> None:
    stage.parts.board.counts_per_rev = 4096


def _slip_slowly(stage: FaultHarness) -> None:
    """Turn the encoder by 1 deg on its spindle, slowly enough for any plausibility."""
    stage.each(lambda since: stage.parts.bench.slip(radians(0.005)) if since < 0.2 else None)


def _delay_lines(stage: FaultHarness) -> None:
    stage.parts.encoder_link.delay = 0.06


def _damage_lines(stage: FaultHarness) -> None:
    stage.parts.board.malformed = 0.02


ENCODER: Final = (
    Fault(
        "encoder unplugged",
        "encoder",
        "its port is gone, while balancing",
        "a stop within a tick, told to look at the encoder",
        _ends("fault"),
        _unplug,
        within=0.02,
        says="encoder",
    ),
    Fault(
        "encoder unplugged in the self-test",
        "encoder",
        "its port is gone, while the flange moves by 40 mm",
        "a stop within a tick",
        _ends("fault"),
        _unplug,
        Trigger("swing", 0.7),
        within=0.02,
        says="encoder",
    ),
    Fault(
        "encoder silent",
        "encoder",
        "no line comes any more, while balancing",
        "a stop once the newest sample is 20 ms old",
        _ends(Rule.ENCODER_STALE),
        _silence,
        within=0.04,
        says="its cable",
    ),
    Fault(
        "encoder frozen",
        "encoder",
        "the count stands still, while balancing",
        "the pendulum is lost; the arm stops on its track",
        FELL | _ends(Rule.ENCODER_JUMP),
        _freeze,
        within=2.0,
    ),
    Fault(
        "encoder frozen before the self-test",
        "encoder",
        "the count stands still, from the reference on",
        "the self-test refuses",
        _ends("self-test"),
        _freeze,
        Trigger("swing"),
    ),
    Fault(
        "count jump",
        "encoder",
        "the count jumps by 5 deg, while balancing",
        "a stop within a tick",
        _ends(Rule.ENCODER_JUMP, Rule.ENCODER_GAP, "fault"),
        lambda stage: stage.parts.board.jump(round(8192 * 5 / 360)),
        within=0.02,
    ),
    Fault(
        "slow count loss",
        "encoder",
        "one of twenty upward counts is lost, from the start of balancing",
        "it balances while the zero can be estimated, then the arm stops on its track",
        FELL | _ends("lasted"),
        _lose_counts,
        Trigger("balancing"),
        lambda scene: on(scene, duration=8.0),
    ),
    Fault(
        "wrong sign",
        "encoder",
        "the counts grow the wrong way, from the start",
        "the self-test names the sign",
        _ends("self-test"),
        _wrong_sign,
        AT_START,
        says="sign",
    ),
    Fault(
        "wrong counts: half",
        "encoder",
        "half the counts per revolution, from the start",
        "the self-test names the counts",
        _ends("self-test"),
        _half_counts,
        AT_START,
        says="counts",
    ),
    Fault(
        "wrong counts: x 1.1",
        "encoder",
        "a tenth more counts per revolution, from the start",
        "the self-test names the counts",
        _ends("self-test"),
        _more_counts,
        AT_START,
        says="counts",
    ),
    Fault(
        "board of another encoder",
        "encoder",
        "the board says 4096 counts per revolution, the rig 8192",
        "the run is refused",
        _ends("refused"),
        _other_board,
        AT_START,
        says="4096",
    ),
    Fault(
        "zeroed while swinging",
        "encoder",
        "the board sets its count to zero, in the self-test",
        "a stop within a tick",
        _ends(Rule.ENCODER_JUMP, Rule.ENCODER_GAP, "fault"),
        lambda stage: stage.parts.board.zero(),
        Trigger("swing", 1.4),
        within=0.03,
    ),
    Fault(
        "zero error",
        "encoder",
        "the encoder slips by 1 deg on its spindle, after the reference",
        "the self-test refuses the zero, it is referenced anew, and balances",
        _ends("lasted"),
        _slip_slowly,
        Trigger("swing"),
        check=lambda stage: (
            () if [one.name for one in stage.told].count("swing") == 2 else ("no second reference",)
        ),
    ),
    Fault(
        "zero error while balancing",
        "encoder",
        "the encoder slips by 1 deg on its spindle, in 0.2 s",
        "the zero is estimated and it balances, or the arm stops on its track",
        FELL | _ends("lasted"),
        _slip_slowly,
    ),
    Fault(
        "stale samples",
        "encoder",
        "lines come 60 ms late, while balancing",
        "a stop once the newest sample is 20 ms old",
        _ends(Rule.ENCODER_STALE),
        _delay_lines,
        within=0.04,
        says="old",
    ),
    Fault(
        "malformed lines",
        "encoder",
        "one of fifty lines is damaged, while balancing",
        "none is believed; a stop once gaps repeat",
        _ends(Rule.ENCODER_GAP),
        _damage_lines,
        within=0.5,
        says="missing",
    ),
    Fault(
        "one lost line",
        "encoder",
        "one line is lost, while balancing",
        "it is told, and goes on: counts are absolute",
        _ends("lasted"),
        lambda stage: stage.parts.board.skip(1),
        says="was lost",
    ),
    Fault(
        "lost lines",
        "encoder",
        "three lines are lost, while balancing",
        "a stop within a tick",
        _ends(Rule.ENCODER_GAP),
        lambda stage: stage.parts.board.skip(3),
        within=0.03,
    ),
    Fault(
        "illegal transition",
        "encoder",
        "both lines of the encoder change at once, while balancing",
        "a stop within a tick",
        _ends(Rule.ENCODER_ILLEGAL),
        lambda stage: stage.parts.board.meet_illegal(),
        within=0.03,
        says="wiring",
    ),
    Fault(
        "board restarts",
        "encoder",
        "the board loses its power for a moment, while balancing",
        "a stop; the zero is void",
        _ends(Rule.ENCODER_STALE, Rule.ENCODER_GAP, "fault"),
        lambda stage: stage.parts.board.reboot(),
        within=0.05,
    ),
)


# Time.


def _hold_up(*times: float) -> Inject:
    def inject(stage: FaultHarness) -> None:
        # Every second wait is for a tick, the other for the setpoint in its middle.
        stage.clock.held_up = list(times)

    return inject


TIME: Final = (
    Fault(
        "late tick",
        "time",
        "the loop is held up for 60 ms, while balancing",
        "a stop in the next tick",
        _ends(Rule.TICK),
        _hold_up(0.06),
        within=0.08,
    ),
    Fault(
        "one late tick",
        "time",
        "the loop is held up for 8 ms, while balancing",
        "it goes on",
        _ends("lasted"),
        _hold_up(0.008),
    ),
    Fault(
        "late ticks",
        "time",
        "the loop is late by 12 ms six times in a row, while balancing",
        "a stop at the third missed tick",
        _ends(Rule.TICK),
        _hold_up(*(6 * (0.012,))),
        within=0.08,
    ),
)


# The robot and its link.


def _drop(stage: FaultHarness) -> None:
    stage.parts.server.faults = Faults(close=True)
    stage.parts.robot_link.close()


def _half_open(stage: FaultHarness) -> None:
    stage.parts.robot_link.cut = stage.parts.robot_link.other.cut = True


def _back_up(stage: FaultHarness) -> None:
    there = stage.parts.robot_link.other
    before, there.delay = there.delay, 0.08
    stage.after(0.1, lambda: setattr(there, "delay", before))


def _refuse(stage: FaultHarness) -> None:
    stage.parts.server.faults = Faults(refuse=1.0)


def _stopped(why: str) -> Inject:
    return lambda stage: stage.parts.bench.body.stop(why)


def _touch(force: float) -> Inject:
    """Press on the flange along the track for 0.3 s [N]."""

    def inject(stage: FaultHarness) -> None:
        bench = stage.parts.bench
        bench.touch((force, 0.0, 0.0))
        stage.after(0.3, lambda: bench.touch((0.0, 0.0, 0.0)))

    return inject


def _no_bytes_after(stage: FaultHarness) -> Sequence[str]:
    fault = stage.broken_at or 0.0
    late = [time for time, _ in stage.robot_wire.sent if time > fault + 0.02]
    if stage.robot_wire.opened != 1:
        return (f"{stage.robot_wire.opened} connections were made",)
    return (f"{len(late)} lines were sent after the drop",) if late else ()


def _pushing(scene: Scenario) -> Scenario:
    """Return a scene whose policy pushes one way only."""
    table = tuple((1.0, *[0.0] * (len(row) - 1)) for row in scene.policy.Q)
    return on(scene, policy=scene.policy.model_copy(update={"Q": table}))


def _stretched(scene: Scenario) -> Scenario:
    """Return a scene with an elbow that is all but stretched at home."""
    home = [degrees(angle) for angle in scene.settings.described_arm.home]
    home[3] = -3.0
    return on(scene, settings=scene.settings.model_copy(update={"home_deg": tuple(home)}))


def _setpoint(change: Callable[[Setpoint, float], Setpoint]) -> Inject:
    """Change each setpoint, given the time since the fault [s]."""

    def inject(stage: FaultHarness) -> None:
        stage.change_setpoint = change

    return inject


def _joint(number: int, value: Callable[[float, float], float]) -> Inject:
    """Change one joint of each setpoint, counted from one."""
    return _setpoint(
        lambda q, since: tuple(
            value(angle, since) if i == number else angle for i, angle in enumerate(q, start=1)
        )
    )


def _creep(*signs: float, rate: float = 0.02) -> Inject:
    """Let the setpoints creep away, each joint at so many times a rate [rad/s]."""
    return _setpoint(
        lambda q, since: tuple(
            angle + sign * rate * since for angle, sign in zip(q, signs, strict=True)
        )
    )


HELD_BACK: Final = _ends("fault")
"""A setpoint that the guard holds back stops the run as a fault."""
MOVED_AWAY: Final = _ends("fault", Rule.FOLLOWING, Rule.DRIFT, Rule.TILT, Rule.TRACK)

ROBOT: Final = (
    Fault(
        "TCP drop",
        "robot",
        "the server closes the connection, while balancing",
        "told within 100 ms that software cannot stop the robot; it rests at its last target",
        _ends("link lost"),
        _drop,
        stoppable=False,
        within=0.02,
    ),
    Fault(
        "half-open link",
        "robot",
        "nothing arrives any more, neither way, while balancing",
        "told within 100 ms that software may be unable to stop the robot",
        _ends("link lost"),
        _half_open,
        stoppable=False,
        within=0.08,
    ),
    Fault(
        "command backlog",
        "robot",
        "commands arrive 80 ms late, while balancing",
        "a stop after 50 ms, and rest",
        _ends(Rule.LINK),
        _back_up,
        within=0.08,
        says="has not answered",
    ),
    Fault(
        "nak",
        "robot",
        "the server refuses setpoints, while balancing",
        "the link is given up; told within 100 ms that software cannot stop the robot",
        _ends("link lost"),
        _refuse,
        stoppable=False,
        within=0.03,
    ),
    Fault(
        "reconnect in mid-run",
        "robot",
        "the connection drops, and could be made again 50 ms later",
        "nobody connects again, and nothing is sent any more",
        _ends("link lost"),
        _drop,
        stoppable=False,
        within=0.02,
        check=_no_bytes_after,
    ),
    Fault(
        "robot not following",
        "robot",
        "the drives stop the arm on its way home",
        "a latched stop; targets go on from where the arm is",
        _ends(Rule.NOT_FOLLOWING, Rule.FOLLOWING),
        _stopped("the drives' protection"),
        Trigger("homing", 0.4),
        within=0.4,
    ),
    Fault(
        "E-stop",
        "robot",
        "the E-stop is pressed, while balancing",
        "a latched stop; targets go on from where the arm is",
        _ends(Rule.NOT_FOLLOWING, Rule.FOLLOWING, Rule.ANGLE),
        _stopped("emergency stop"),
        within=0.4,
    ),
    Fault(
        "E-stop before the release",
        "robot",
        "the E-stop is pressed, the pendulum held",
        "a latched stop as soon as the arm should move",
        _ends(Rule.NOT_FOLLOWING, Rule.FOLLOWING, Rule.ANGLE),
        _stopped("emergency stop"),
        Trigger("armed"),
    ),
    Fault(
        "mode change",
        "robot",
        "another mode is selected, in the self-test",
        "a latched stop; targets go on from where the arm is",
        _ends(Rule.NOT_FOLLOWING, Rule.FOLLOWING),
        _stopped("change of the operating mode"),
        Trigger("swing", 0.5),
        within=0.5,
    ),
    Fault(
        "contact",
        "robot",
        "60 N press on the flange, along the track, while balancing",
        "a stop at the next torques",
        _ends(Rule.TORQUE),
        _touch(60.0),
        within=0.1,
        says="touches the arm",
    ),
    Fault(
        "contact on the way home",
        "robot",
        "150 N press on the flange on the way home",
        "a stop at the next torques",
        _ends(Rule.TORQUE),
        _touch(150.0),
        Trigger("homing", 0.3),
        within=0.1,
    ),
    Fault(
        "joint limit",
        "robot",
        "a setpoint of A2 near its limit, while balancing",
        "it is held back; the guard brings the arm to rest",
        HELD_BACK,
        _joint(2, lambda q, since: radians(118.5)),
        within=0.03,
        says="joint 2",
    ),
    Fault(
        "velocity limit",
        "robot",
        "setpoints of A7 are 0.02 rad away at once, while balancing",
        "they are held back; the guard brings the arm to rest",
        HELD_BACK,
        _joint(7, lambda q, since: q + 0.02),
        within=0.03,
        says="rad/s, expected",
    ),
    Fault(
        "acceleration limit",
        "robot",
        "setpoints of A7 run away by 30 rad/s^2, while balancing",
        "they are held back; the guard brings the arm to rest",
        HELD_BACK,
        _joint(7, lambda q, since: q + 15.0 * since**2),
        within=0.04,
        says="rad/s^2, expected",
    ),
    Fault(
        "runaway",
        "robot",
        "setpoints of A7 run away by 5 rad/s^2, while balancing",
        "a stop once the arm is 0.03 rad from where it should be for 50 ms",
        MOVED_AWAY,
        _joint(7, lambda q, since: q + 2.5 * since**2),
        within=0.4,
    ),
    Fault(
        "track limit",
        "robot",
        "a policy that pushes one way only",
        "a stop from which the flange rests on its track",
        _ends(Rule.TRACK, Rule.ANGLE),
        scene=_pushing,
        moment=Trigger("balancing"),
        within=1.0,
    ),
    Fault(
        "too fast for T1",
        "robot",
        "the pendulum is pushed by 1 rad/s, in T1",
        "a stop where the flange reaches 0.23 m/s",
        _ends(Rule.SPEED),
        lambda stage: stage.parts.bench.push(1.0),
        scene=lambda scene: on(scene, t1=True),
        within=0.5,
        says="0.23 m/s",
    ),
    Fault(
        "near singularity",
        "robot",
        "a home with the elbow all but stretched",
        "the run is refused",
        _ends("refused"),
        moment=AT_START,
        scene=_stretched,
        says="home",
    ),
    Fault(
        "flange drift",
        "robot",
        "setpoints of A2 and A6 creep, so that the flange leaves its line",
        "a stop at 15 mm",
        _ends(Rule.DRIFT),
        _creep(0.0, 1.0, 0.0, 0.0, 0.0, -1.0, 0.0),
        within=3.0,
        says="off its line",
    ),
    Fault(
        "flange pitch error",
        "robot",
        "setpoints of A2, A4 and A6 creep, so that the flange tilts",
        "a stop at 2 deg, or at 15 mm",
        _ends(Rule.TILT, Rule.DRIFT),
        _creep(0.0, 0.4, 0.0, -1.0, 0.0, 1.0, 0.0),
        within=3.0,
    ),
    Fault(
        "first command away from the measured pose",
        "robot",
        "the first setpoint is 0.02 rad from where the arm is",
        "nothing is sent",
        _ends("fault", "link lost"),
        _setpoint(lambda q, since: tuple(angle + 0.02 for angle in q)),
        AT_START,
        says="nothing was sent",
    ),
    Fault(
        "unit slip in the setpoints",
        "robot",
        "setpoints become degrees, while balancing",
        "they are held back; the guard brings the arm to rest",
        HELD_BACK,
        _setpoint(lambda q, since: tuple(map(degrees, q))),
        within=0.03,
    ),
)


# Numbers that are none.


def _inputs(change: Callable[[TickInputs], TickInputs]) -> Inject:
    def inject(stage: FaultHarness) -> None:
        stage.change_inputs = change

    return inject


def _each_sample(**changes: Any) -> Inject:
    return _inputs(
        lambda inputs: inputs._replace(
            samples=[one._replace(**changes) for one in inputs.samples]  # type: ignore[attr-defined]
        )
    )


def _each_reply(change: Callable[[Any], Any]) -> Inject:
    return _inputs(lambda inputs: inputs._replace(replies=[change(one) for one in inputs.replies]))


def _no_joints(reply: Any) -> Any:
    return reply if reply.q is None else reply._replace(q=(nan,) * len(reply.q))


def _no_torques(reply: Any) -> Any:
    return reply if reply.torque is None else reply._replace(torque=(nan,) * len(reply.torque))


def _nan_line(stage: FaultHarness) -> None:
    def spoil(data: bytes) -> bytes:
        return b"_".join([b"NaN"] * 7) + b"\n" if data else data

    stage.robot_wire.spoil = spoil


def _nan_count(stage: FaultHarness) -> None:
    stage.encoder_wire.spoil = lambda data: data and b"E,nan,nan,nan,0*00\n"


NUMBERS: Final = (
    Fault(
        "NaN from the encoder's line",
        "numbers",
        "lines hold nan, while balancing",
        "none is believed; a stop once the newest sample is 20 ms old",
        _ends(Rule.ENCODER_STALE, Rule.ENCODER_GAP, "fault"),
        _nan_count,
        within=0.05,
    ),
    Fault(
        "NaN from the robot's line",
        "numbers",
        "answers hold NaN, while balancing",
        "the link is given up; told within 100 ms that software cannot stop the robot",
        _ends("link lost"),
        _nan_line,
        stoppable=False,
        within=0.03,
    ),
    Fault(
        "NaN in a sample's time",
        "numbers",
        "the encoder's driver gives NaN for a time, while balancing",
        "a stop within a tick",
        _ends(Rule.NUMBER, Rule.ENCODER_JUMP, "fault"),
        _each_sample(time=nan),
        within=0.02,
    ),
    Fault(
        "NaN in measured joints",
        "numbers",
        "the robot's driver gives NaN for joints, while balancing",
        "a stop within a tick",
        _ends(Rule.NUMBER, "fault"),
        _each_reply(_no_joints),
        within=0.02,
    ),
    Fault(
        "NaN in torques",
        "numbers",
        "the robot's driver gives NaN for torques, while balancing",
        "a stop at the next torques",
        _ends(Rule.NUMBER, "fault"),
        _each_reply(_no_torques),
        within=0.08,
    ),
    Fault(
        "NaN in a setpoint",
        "numbers",
        "the controller gives NaN, while balancing",
        "it is held back; the guard brings the arm to rest",
        HELD_BACK,
        _joint(1, lambda q, since: nan),
        within=0.03,
        says="finite",
    ),
    Fault(
        "infinity in a setpoint",
        "numbers",
        "the controller gives infinity, on the way home",
        "it is held back; the guard brings the arm to rest",
        HELD_BACK,
        _joint(3, lambda q, since: inf),
        Trigger("homing", 0.3),
        within=0.03,
        says="finite",
    ),
    Fault(
        "six numbers in a setpoint",
        "numbers",
        "the controller gives six joints, while balancing",
        "it is held back; the guard brings the arm to rest",
        HELD_BACK,
        _setpoint(lambda q, since: q[:6]),
        within=0.03,
        says="7",
    ),
    Fault(
        "controller fails",
        "numbers",
        "the controller raises an exception, while balancing",
        "the guard brings the arm to rest",
        _ends("fault"),
        _inputs(lambda inputs: inputs._replace(samples=[None])),  # type: ignore[list-item]
        within=0.03,
        says="the controller failed",
    ),
)


# The release.


def _let_go_in_mid_lift(stage: FaultHarness) -> None:
    stage.each(lambda since: _drop_it(stage))
    stage.after(9.0, lambda: stage.typed.append("stop"))


def _drop_it(stage: FaultHarness) -> None:
    bench = stage.parts.bench
    if bench.hand.holds and abs(abs(remainder(bench.phi, 2.0 * pi)) - radians(40.0)) < radians(2.0):
        bench.let_go()


def _take_away(duration: float) -> Inject:
    """Hold on for 4 s, then bring the pendulum down in so long [s]."""

    def inject(stage: FaultHarness) -> None:
        bench = stage.parts.bench

        def down() -> None:
            manner = draw_hand_params(np.random.default_rng(0), clumsy=0.0)
            bench.hand.steady(bench.now, bench.phi, manner._replace(lifting=duration))

        stage.after(4.0, down)
        stage.after(9.0, lambda: stage.typed.append("stop"))

    return inject


def _never_began(stage: FaultHarness) -> Sequence[str]:
    if any(one.name == "balancing" for one in stage.told):
        return ("the policy began",)
    return ()


RELEASE: Final = (
    Fault(
        "release too early",
        "release",
        "the pendulum is let go 40 deg from upright",
        "the policy does not begin; the arm holds still until a key is pressed",
        _ends("operator"),
        _let_go_in_mid_lift,
        Trigger("lift"),
        check=_never_began,
    ),
    Fault(
        "release too late",
        "release",
        "armed, the pendulum is held for 4 s more, and then taken down in 0.8 s",
        "the policy does not begin: the hand is still on",
        _ends("operator"),
        _take_away(0.8),
        Trigger("armed"),
        lambda scene: on(scene, unheard=frozenset({"armed", "disarmed", "nudge"})),
        check=_never_began,
        says="still on",
    ),
    Fault(
        "hand that falls with the pendulum",
        "release",
        "armed, the pendulum is led down in 2.5 s, which begins as a fall does",
        "it may be taken for a release; the arm then stops at the angle, on its track",
        FELL | _ends("operator"),
        _take_away(2.5),
        Trigger("armed"),
        lambda scene: on(scene, unheard=frozenset({"armed", "disarmed", "nudge"})),
        held_at_start=True,
    ),
    Fault(
        "push",
        "release",
        "the pendulum is pushed by 20 deg/s, while balancing",
        "it balances, or falls and the arm stops",
        FELL | _ends("lasted"),
        lambda stage: stage.parts.bench.push(radians(20.0)),
    ),
    Fault(
        "hard push",
        "release",
        "the pendulum is pushed by 250 deg/s, while balancing",
        "it falls, and the arm stops on its track",
        FELL | _ends(Rule.ENCODER_JUMP),
        lambda stage: stage.parts.bench.push(radians(250.0)),
        within=0.6,
    ),
)


# The operator.


def _key(stage: FaultHarness) -> None:
    stage.typed.append("stop")


def _keys(phase: str, after: float) -> Fault:
    return Fault(
        f"key: {phase}",
        "operator",
        f"a key, {after:g} s after `{phase}`",
        "a stop within a tick",
        _ends("operator"),
        _key,
        Trigger(phase, after),
        within=0.02,
        says="operator",
    )


OPERATOR: Final = tuple(
    _keys(phase, after)
    for phase, after in (
        ("homing", 0.5),
        ("hang", 1.0),
        ("swing", 0.6),
        ("lift", 1.5),
        ("armed", 0.1),
        ("balancing", 1.0),
    )
)


# What is given.


def _other_arm(scene: Scenario) -> Scenario:
    return on(scene, settings=scene.settings.model_copy(update={"arm": "iiwa14"}))


def _radians_for_degrees(scene: Scenario) -> Scenario:
    home = tuple(radians(angle) for angle in scene.settings.home_deg)
    return on(scene, settings=scene.settings.model_copy(update={"home_deg": home}))


INPUTS: Final = (
    Fault(
        "policy of another rig",
        "input",
        "the policy was trained on an iiwa 7, the rig has an iiwa 14",
        "the run is refused",
        _ends("refused"),
        moment=AT_START,
        scene=_other_arm,
        says="trained on",
    ),
    Fault(
        "unit slip",
        "input",
        "home in rig.toml is given in radians",
        "the run is refused",
        _ends("refused"),
        moment=AT_START,
        scene=_radians_for_degrees,
        says="home",
    ),
)

FAULTS: Final = (*ENCODER, *TIME, *ROBOT, *NUMBERS, *RELEASE, *OPERATOR, *INPUTS)
"""Those that are shown on the stage, in virtual time."""
