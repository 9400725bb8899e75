"""Vocabulary of runs and trials: the phases of a run on a rig, its safety rules, and all ends.

An `Outcome` is a code, and an `End` adds its evidence as numbers and texts by name. Programs read
codes and evidence alone; `describe` makes the sentence for people, at the edge.

A safety rule is a row of `Outcome`. Rules over one of the `SafetyInputs` have their limit there;
`equipoise.safety.rules` evaluates all.
"""

from collections.abc import Mapping
from enum import Enum, StrEnum
from math import degrees, inf, radians
from types import MappingProxyType
from typing import Final, NamedTuple, Self

Evidence = Mapping[str, float | str]
"""Numbers in SI units and texts, by name."""
Numbers = tuple[float, ...]
"""One number per joint."""
MAX_STALL: Final = 0.070
"""Maximum duration of a stall of the loop, of the encoder or of the link that is bridged [s]. On
the twin a balance outlasts 80 ms of each; the operator has to know within 100 ms that software can
no longer stop the robot."""
MAX_MEASUREMENT_AGE: Final = 0.120
"""Maximum age of the newest measured joints [s]: a bridged stall of 70 ms, up to 15 ms from the
last measurement to its start, up to 35 ms until a setpoint after it is answered with joints. Older
ones do not show whether the arm follows, or where its flange is."""
MAX_COUNT_JUMP: Final = radians(0.6)
"""Maximum unexplained deviation of a count from the straight line through the two before [rad],
beyond the encoder's resolution, errors of its time stamps, and gravity."""


class Phase(Enum):
    """Phase of a run; a simulated one swings up and balances only."""

    HOMING = "homing"
    """On the way home, inside the servo stream."""
    AT_HOME = "at home"
    """Held at home, until the operator confirms."""
    REFERENCING = "referencing"
    """Held, the pendulum hanging, until it is still and the button is pressed."""
    SELF_TEST = "self-test"
    """The flange moves by 40 mm, the pendulum answers and swings out."""
    EXCITING = "exciting"
    """Every joint moves about home, the pendulum hanging; then the arm is identified."""
    LIFTING = "lifting"
    """Held, the operator lifts the pendulum."""
    ARMED = "armed"
    """Held, the pendulum stands in a hand that may release it."""
    DAMPING = "damping"
    """The flange takes the swing from the pendulum."""
    SWINGING_UP = "swinging up"
    """The flange swings the hanging pendulum up."""
    BALANCING = "balancing"
    """The policy commands."""
    STOPPING = "stopping"
    """On the way to rest, inside the servo stream. Latched."""


class SafetyInputs(NamedTuple):
    """State of a run at a tick; the defaults break no rule."""

    lateness: float = 0.0
    """Lateness of the tick [s]."""
    overdue: float = 0.0
    """Time since the oldest setpoint without a reply [s]."""
    measured_age: float = 0.0
    """Age of the newest measured joints [s]."""
    measured: Numbers | None = None
    """Measured joints [rad], all of them; None without a new measurement."""
    expected: Numbers | None = None
    """Joints of the arm's model at the time of `measured` [rad]."""
    torque: Numbers | None = None
    """External torques less those at rest [N m]; None without a new measurement."""
    encoder_age: float = 0.0
    """Age of the newest encoder sample [s]."""
    encoder_illegal: bool = False
    """Whether the board found an illegal transition since the tick before."""
    encoder_missing: int = 0
    """Encoder samples lost since the tick before."""
    encoder_jump: float = 0.0
    """Maximum `unexplained_turn` since the tick before [rad]."""
    balancing: bool = False
    """Whether the policy commands."""
    x: float = 0.0
    """Displacement of the flange from home along base x [m]."""
    x_dot: float = 0.0
    """Its velocity [m/s]."""
    phi: float = 0.0
    """Angle of the pendulum from upright [rad]."""
    on_track: bool = False
    """Whether the flange has to be on its track, in line and orientation; not on the way home."""
    manipulability: float = inf
    """Manipulability |det J| [m^3]; inf if unchecked."""
    drift: float = 0.0
    """Distance of the flange from its line [m]."""
    tilt: float = 0.0
    """Angle of the flange from its orientation [rad]."""


class Bound(NamedTuple):
    """Limit of a safety rule on one input."""

    name: str
    """Name of the input, a field of `SafetyInputs`."""
    limit: float
    """Its largest permitted value."""


class EndCause(StrEnum):
    """A cause of an end: its name, with advice, a sentence, and the limit of a rule."""

    advice: str
    """Advice against it."""
    sentence: str
    """Sentence of an end, with its evidence: the value, the expected one, a remedy. `_ms` stands
    for thousandths (ms or mm) of a value, `_deg` for degrees."""
    bound: Bound | None
    """Limit of a safety rule on one input; None for all others."""

    def __new__(
        cls, name: str, advice: str, sentence: str = "{text}", bound: Bound | None = None
    ) -> Self:
        """Create a member, whose value is its name."""
        member = str.__new__(cls, name)
        member._value_ = name
        member.advice, member.sentence, member.bound = advice, sentence, bound
        return member


CONTINUE: Final = "go on with the next run"
RELAX: Final = "move home away from the limit, or lower the gains of CLIK"
REPORT: Final = "keep this log and report it"
CHECK_LINK: Final = "check cable and network; `equipoise rig doctor` measures round trips"
CHECK_PANEL: Final = "check the robot's panel: emergency stop, enabling switch, mode"
CHECK_MOUNTING: Final = "check the mounting of base and flange, and the actuator in use"
FREE_COMPUTER: Final = (
    "end other programs; find with `equipoise rig doctor` what delays this machine"
)
CHECK_ENCODER: Final = "check the encoder's cable, power, coupling and wiring"
REPAIR: Final = "repair what the evidence names"


class Outcome(EndCause):
    """How a trial or a run ended.

    The safety rules, from `NUMBER` to `ANGLE`, stand in the order in which they are named: first
    those that make all other numbers meaningless, then limits of the robot, then harm, then the end
    of the balance.
    """

    SURVIVED = "survived", CONTINUE, "the pendulum stayed up for {duration:g} s; it falls now"
    JOINT_LIMIT = "joint limit", RELAX, "the policy asks for more than a joint can do"
    NOT_UPRIGHT = (
        "not upright",
        "evaluate with --start hanging; identify pendulum and arm again",
        "the swing-up did not bring the pendulum upright within {value:g} s",
    )

    NUMBER = "not a number", REPORT, "{name} is {got}, expected a finite number"
    COUNT = (
        "wrong count",
        REPORT,
        "{name} has {value:g} numbers, expected {limit:g}, one per joint",
    )
    LINK = (
        "link overdue",
        CHECK_LINK,
        "the robot has not answered for {value_ms:.0f} ms, expected at most {limit_ms:.0f} ms; "
        "software may be unable to stop it: use the emergency stop",
        Bound("overdue", MAX_STALL),
    )
    NOT_FOLLOWING = (
        "robot not following",
        CHECK_PANEL,
        "joint {joint:g} stands still where it should have moved by {value:.3f} rad: emergency "
        "stop, enabling switch, protective stop, another mode or its encoder",
    )
    TORQUE = (
        "contact",
        "find what the arm touched before it moves again",
        "the external torque at joint {joint:g} is {value:.1f} N m from that at rest, expected at "
        "most {limit:.1f} N m: something touches the arm",
    )
    FOLLOWING = (
        "following error",
        CHECK_PANEL,
        "joint {joint:g} is {value:.3f} rad from where it is expected for {duration_ms:.0f} ms, "
        "expected at most {limit:g} rad",
    )
    FIRST = (
        "first setpoint",
        CHECK_PANEL,
        "joint {joint:g} is measured {value:.4f} rad from the posture at the start, expected at "
        "most {limit:g} rad: a reply or the first setpoint is wrong, or the arm moves",
    )
    POSITION = (
        "joint position",
        RELAX,
        "the setpoint of joint {joint:g} leads to {value:.4f} rad, expected {lower:.4f} to "
        "{upper:.4f} rad: its limits less the margin of the rig",
    )
    JUMP = (
        "jump",
        RELAX,
        "the setpoint of joint {joint:g} jumps by {value:.4f} rad, expected at most {limit:.4f} "
        "rad; are its units right?",
    )
    VELOCITY = (
        "joint velocity",
        RELAX,
        "the setpoint of joint {joint:g} asks for {value:.3f} rad/s, expected at most {limit:.3f} "
        "rad/s",
    )
    ACCELERATION = (
        "joint acceleration",
        RELAX,
        "the setpoint of joint {joint:g} asks for {value:.2f} rad/s^2, expected at most "
        "{limit:.2f} rad/s^2",
    )
    SINGULAR = (
        "near singularity",
        RELAX,
        "the arm is near a singularity: |det J| is {value:.2g} m^3, expected at least {limit:.2g} "
        "m^3",
    )
    TRACK = (
        "track",
        "train a policy that stays on the track of the twin (`equipoise evaluate`)",
        "the flange is at {x:.3f} m with {x_dot:.3f} m/s and could be stopped at {reach:.3f} m, "
        "expected less than {limit:g} m from home",
    )
    SPEED = (
        "flange speed",
        "train for this limit (--set plant.max_speed), raise it, or speed up the link",
        "the flange moves at {value:.3f} m/s, expected less than {limit:.3g} m/s",
    )
    DRIFT = (
        "flange drift",
        CHECK_MOUNTING,
        "the flange is {value_ms:.1f} mm off its line, expected at most {limit_ms:g} mm",
    )
    TILT = (
        "flange tilt",
        CHECK_MOUNTING,
        "the flange is tilted by {value_deg:.2f} deg, expected at most {limit_deg:g} deg",
    )
    TICK = (
        "late tick",
        FREE_COMPUTER,
        "the loop was {value_ms:.1f} ms late, expected at most {limit_ms:g} ms; `equipoise rig "
        "doctor` looks for the cause",
        Bound("lateness", MAX_STALL),
    )
    MEASUREMENT_STALE = (
        "stale joints",
        CHECK_LINK,
        "the joints were last measured {value_ms:.0f} ms ago, expected at most {limit_ms:g} ms: "
        "the robot's link is too slow; look at its cable and its network",
        Bound("measured_age", MAX_MEASUREMENT_AGE),
    )
    ENCODER_STALE = (
        "stale encoder",
        CHECK_ENCODER,
        "the newest encoder sample is {value_ms:.1f} ms old, expected at most {limit_ms:g} ms; "
        "look at its cable",
        Bound("encoder_age", MAX_STALL),
    )
    ENCODER_ILLEGAL = (
        "illegal transition",
        CHECK_ENCODER,
        "the encoder's lines changed both at once: counts are lost; look at its wiring",
        Bound("encoder_illegal", 0.0),
    )
    ENCODER_GAP = (
        "encoder gap",
        CHECK_ENCODER,
        "{value:g} encoder samples are missing, expected one at most, and that seldom; look at "
        "its cable and at the load of this machine",
        Bound("encoder_missing", 0.0),
    )
    ENCODER_JUMP = (
        "count jump",
        CHECK_ENCODER,
        "the encoder jumped by {value_deg:.2f} deg more than a pendulum moves, expected at most "
        "{limit_deg:g} deg; look at its coupling",
        Bound("encoder_jump", MAX_COUNT_JUMP),
    )
    ANGLE = (
        "angle",
        "evaluate the policy on the twin; if it balances there, `equipoise refine` it with this",
        "the pendulum leans by {value_deg:.1f} deg, expected less than {limit_deg:g} deg",
    )

    # Further ends of a run on a rig.
    OPERATOR = "operator", CONTINUE, "stopped by the operator ({typed})"
    DRY_RUN = "dry run", CONTINUE, "all steps before the motion passed; nothing has moved"
    SELF_TEST = "self-test", "follow the advice of the self-test"
    """The pendulum did not match its model, before it was lifted."""
    STALLS = (
        "repeated stalls",
        FREE_COMPUTER,
        "loop or link stalled {value:g} times within {duration:g} s while the arm moved, at last "
        "{name}; expected fewer; `equipoise rig doctor` looks for the cause",
    )
    UNIDENTIFIED = (
        "arm not identified",
        "follow the evidence; where this run wrote an actuator file, train with --actuator and "
        "that file",
        "the arm is not identified: {text}",
    )
    POLICY = (
        "policy failed",
        "correct the policy, and try it on --robot twin:nominal first",
        "the policy failed: {text}",
    )
    ENCODER_LOST = "encoder lost", CHECK_ENCODER
    """The encoder's link failed."""
    LINK_LOST = "link lost", "follow the evidence; `equipoise rig doctor` measures the link"
    """The robot's link failed: software cannot stop the arm any more."""
    FAULT = "fault", REPAIR
    """The controller, a driver or another part of the run failed."""
    ERROR = "error", REPAIR
    """An error ended the program."""
    EXCITED = "excited", "identify the actuator from this log with `equipoise identify`"
    """The arm was excited; no policy ran."""
    BROKEN_OFF = (
        "log broken off",
        "find what ended the program: power, memory, a full disk, a signal",
    )
    """The log ends before the run."""


SAFETY_RULES: Final = tuple(Outcome)[
    list(Outcome).index(Outcome.NUMBER) : list(Outcome).index(Outcome.ANGLE) + 1
]
"""Safety rules; of several broken ones the first is reported. Kernels name a rule by its index."""
SYMPTOMS: Final = frozenset(
    (
        *(Outcome.JOINT_LIMIT, Outcome.POSITION, Outcome.JUMP, Outcome.VELOCITY),
        *(Outcome.ACCELERATION, Outcome.SINGULAR, Outcome.TRACK, Outcome.SPEED, Outcome.ANGLE),
        *(Outcome.FAULT, Outcome.ERROR, Outcome.BROKEN_OFF),
    )
)
"""Ends that name a symptom: causes that the measurements show explain them better."""
TRIAL_OUTCOMES: Final = (
    *(Outcome.SURVIVED, Outcome.ANGLE, Outcome.TRACK, Outcome.JOINT_LIMIT, Outcome.NOT_UPRIGHT),
    *SAFETY_RULES,
)
"""Outcomes of a trial by the code that kernels return (`equipoise.model.grid`)."""
EXIT_CODES: Final = {
    Outcome.SURVIVED: 0,
    Outcome.DRY_RUN: 0,
    Outcome.OPERATOR: 130,
    Outcome.LINK: 3,
    Outcome.MEASUREMENT_STALE: 3,
    Outcome.LINK_LOST: 3,
    Outcome.ENCODER_LOST: 3,
    Outcome.FAULT: 3,
}
"""Exit codes of a run; 1 for all others: a fall or a broken rule."""


class End(NamedTuple):
    """End of a trial or a run, or the cause of a stop."""

    outcome: Outcome
    """How it ended."""
    evidence: Evidence = MappingProxyType({})
    """Numbers and texts of the end, by the names in its sentence."""


def describe(end: End) -> str:
    """Return an end as a sentence for people; its name where it has no evidence.

    The evidence may come from a file: of names that are missing, the others are listed.
    """
    values = dict(end.evidence)
    numbers = {name: value for name, value in values.items() if not isinstance(value, str)}
    for name, value in numbers.items():
        values |= {f"{name}_ms": 1e3 * value, f"{name}_deg": degrees(value)}
    try:
        return end.outcome.sentence.format_map(values)
    except (LookupError, ValueError):
        shown = {name: f"{value:.4g}" for name, value in numbers.items()}
        known = (f"{name} {value}" for name, value in (dict(end.evidence) | shown).items())
        return ", ".join((end.outcome, *known))
