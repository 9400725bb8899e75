"""Vocabulary of runs and trials: the phases of a run on a rig, and the ends of all of them.

An `Outcome` is a code, and an `End` adds its evidence as numbers and texts by name. Programs read
codes and evidence alone; `describe` makes the sentence for people, at the edge.
"""

from collections.abc import Mapping
from enum import Enum, StrEnum
from math import degrees
from types import MappingProxyType
from typing import Final, NamedTuple, TypeAlias

Evidence: TypeAlias = Mapping[str, float | str]
"""Numbers in SI units and texts, by name."""


class Phase(Enum):
    """Phase of a run on a rig."""

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
    BALANCING = "balancing"
    """The policy commands."""
    STOPPING = "stopping"
    """On the way to rest, inside the servo stream. Latched."""


class Outcome(StrEnum):
    """How a trial or a run ended."""

    LASTED = "lasted"
    """It lasted to its end."""
    JOINT_LIMIT = "joint limit"
    """A command exceeded what a joint can do."""

    # Safety rules: first those that make all other numbers meaningless, then limits of the robot,
    # then harm, then the end of the balance.
    NUMBER = "not a number"
    """A value is not a finite number."""
    COUNT = "wrong count"
    """A setpoint has more or fewer numbers than the arm has joints."""
    LINK = "link overdue"
    """The robot does not answer in time: software may be unable to stop it."""
    NOT_FOLLOWING = "robot not following"
    """A joint stands still while it should move: something else has stopped the arm."""
    TORQUE = "contact"
    """External torque: something touches the arm."""
    FOLLOWING = "following error"
    """The arm is not where it should be."""
    FIRST = "first setpoint"
    """The first setpoint, or another reading at the start, is away from the measured posture."""
    POSITION = "joint position"
    """A setpoint is too near to a position limit, or could not be stopped before it."""
    JUMP = "jump"
    """A setpoint is far from the one before."""
    VELOCITY = "joint velocity"
    """A setpoint asks for more than the joint's velocity."""
    ACCELERATION = "joint acceleration"
    """A setpoint asks for more than the joint's acceleration."""
    SINGULAR = "near singularity"
    """The arm is close to a singular posture."""
    TRACK = "track"
    """The flange reached the end of its track, or could not be stopped within it any more."""
    SPEED = "flange speed"
    """The flange reached its speed limit."""
    DRIFT = "flange drift"
    """The flange has left its line."""
    TILT = "flange tilt"
    """The flange has left its orientation."""
    TICK = "late tick"
    """The loop does not keep its time."""
    MEASUREMENT_STALE = "stale joints"
    """No measured joints came for too long: the robot answers too late, or without them."""
    ENCODER_STALE = "stale encoder"
    """No encoder sample came for too long."""
    ENCODER_ILLEGAL = "illegal transition"
    """The encoder's two lines changed at once: counts are lost."""
    ENCODER_GAP = "encoder gap"
    """Encoder samples are missing: how far it turned meanwhile is not known."""
    ENCODER_JUMP = "count jump"
    """The counts moved as no pendulum does."""
    ANGLE = "angle"
    """The pendulum has fallen."""

    # Further ends of a run on a rig.
    OPERATOR = "operator"
    """The operator stopped it."""
    DRY_RUN = "dry run"
    """It ended before the arm moved, as requested."""
    SELF_TEST = "self-test"
    """The pendulum did not match its model, before it was lifted."""
    STALLS = "repeated stalls"
    """The loop or the robot's link stalled too often while the arm moved."""
    UNIDENTIFIED = "arm not identified"
    """The excitation before the lift identified no arm that the policy was trained for."""
    POLICY = "policy failed"
    """The policy raised, exceeded its time limit, or returned no finite number."""
    ENCODER_LOST = "encoder lost"
    """The encoder's link failed."""
    LINK_LOST = "link lost"
    """The robot's link failed: software cannot stop the arm any more."""
    FAULT = "fault"
    """The controller, a driver or another part of the run failed."""
    ERROR = "error"
    """An error ended the program."""
    EXCITED = "excited"
    """The arm was excited; no policy ran."""
    BROKEN_OFF = "log broken off"
    """The log ends before the run."""


SAFETY_RULES: Final = tuple(Outcome)[
    list(Outcome).index(Outcome.NUMBER) : list(Outcome).index(Outcome.ANGLE) + 1
]
"""Safety rules; of several broken ones the first is named. Kernels name a rule by its index."""
TRIAL_OUTCOMES: Final = (
    *(Outcome.LASTED, Outcome.ANGLE, Outcome.TRACK, Outcome.JOINT_LIMIT),
    *SAFETY_RULES,
)
"""Outcomes of a trial by the code that kernels return (`equipoise.control.grid`)."""
EXIT_CODES: Final = {
    Outcome.LASTED: 0,
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
    """Numbers and texts of the end, by the names in `SENTENCES`."""


SENTENCES: Final = {
    Outcome.LASTED: "the pendulum stood for {duration:g} s: catch it",
    Outcome.JOINT_LIMIT: "the policy asks for more than a joint can do",
    Outcome.NUMBER: "{name} is {got}, expected a finite number",
    Outcome.COUNT: "{name} has {value:g} numbers, expected {limit:g}, one per joint",
    Outcome.LINK: "the robot has not answered for {value_ms:.0f} ms, expected at most "
    "{limit_ms:.0f} ms; software may be unable to stop it: use the emergency stop",
    Outcome.NOT_FOLLOWING: "joint {joint:g} stands still where it should have moved by {value:.3f} "
    "rad: emergency stop, enabling switch, protective stop, another mode or its encoder",
    Outcome.TORQUE: "the external torque at joint {joint:g} is {value:.1f} N m from that at rest, "
    "expected at most {limit:.1f} N m: something touches the arm",
    Outcome.FOLLOWING: "joint {joint:g} is {value:.3f} rad from where it is expected for "
    "{lasted_ms:.0f} ms, expected at most {limit:g} rad",
    Outcome.FIRST: "joint {joint:g} is measured {value:.4f} rad from the posture at the start, "
    "expected at most {limit:g} rad: a reply or the first setpoint is wrong, or the arm moves",
    Outcome.POSITION: "the setpoint of joint {joint:g} leads to {value:.4f} rad, expected "
    "{lower:.4f} to {upper:.4f} rad: its limits less the margin of the rig",
    Outcome.JUMP: "the setpoint of joint {joint:g} jumps by {value:.4f} rad, expected at most "
    "{limit:.4f} rad; are its units right?",
    Outcome.VELOCITY: "the setpoint of joint {joint:g} asks for {value:.3f} rad/s, expected at "
    "most {limit:.3f} rad/s",
    Outcome.ACCELERATION: "the setpoint of joint {joint:g} asks for {value:.2f} rad/s^2, expected "
    "at most {limit:.2f} rad/s^2",
    Outcome.SINGULAR: "the arm is near a singularity: |det J| is {value:.2g} m^3, expected at "
    "least {limit:.2g} m^3",
    Outcome.TRACK: "the flange is at {x:.3f} m with {x_dot:.3f} m/s and could be stopped at "
    "{reach:.3f} m, expected less than {limit:g} m from home",
    Outcome.SPEED: "the flange moves at {value:.3f} m/s, expected less than {limit:.3g} m/s",
    Outcome.DRIFT: "the flange is {value_ms:.1f} mm off its line, expected at most {limit_ms:g} mm",
    Outcome.TILT: "the flange is tilted by {value_deg:.2f} deg, expected at most {limit_deg:g} deg",
    Outcome.TICK: "the loop was {value_ms:.1f} ms late, expected at most {limit_ms:g} ms; "
    "`equipoise rig doctor` looks for the cause",
    Outcome.MEASUREMENT_STALE: "the joints were last measured {value_ms:.0f} ms ago, expected at "
    "most {limit_ms:g} ms: the robot's link is too slow; look at its cable and its network",
    Outcome.ENCODER_STALE: "the newest encoder sample is {value_ms:.1f} ms old, expected at most "
    "{limit_ms:g} ms; look at its cable",
    Outcome.ENCODER_ILLEGAL: "the encoder's lines changed both at once: counts are lost; look at "
    "its wiring",
    Outcome.ENCODER_GAP: "{value:g} encoder samples are missing, expected one at most, and that "
    "seldom; look at its cable and at the load of this machine",
    Outcome.ENCODER_JUMP: "the encoder jumped by {value_deg:.2f} deg more than a pendulum moves, "
    "expected at most {limit_deg:g} deg; look at its coupling",
    Outcome.ANGLE: "the pendulum leans by {value_deg:.1f} deg, expected less than {limit_deg:g} "
    "deg",
    Outcome.STALLS: "loop or link stalled {value:g} times within {duration:g} s while the arm "
    "moved, at last {name}; expected fewer; `equipoise rig doctor` looks for the cause",
    Outcome.OPERATOR: "stopped by the operator ({typed})",
    Outcome.DRY_RUN: "all steps before the motion passed; nothing has moved",
    Outcome.UNIDENTIFIED: "the arm is not identified: {text}",
    Outcome.POLICY: "the policy failed: {text}",
}
"""Sentence of an end with its evidence: the value, the expected one, a remedy; its text otherwise.
`_ms` stands for thousandths (ms or mm) of a value, `_deg` for degrees."""


class _Number(float):
    """Number of a sentence, short whatever its size."""

    def __format__(self, decimals: str) -> str:
        return super().__format__(decimals if abs(self) < 1e6 else ".3g")


def describe(end: End) -> str:
    """Return an end as a sentence for people; its name where it has no evidence.

    The evidence may come from a file: of names that are missing, the others are listed.
    """
    values = dict(end.evidence)
    numbers = {name: value for name, value in values.items() if not isinstance(value, str)}
    for name, value in numbers.items():
        units = {name: value, f"{name}_ms": 1e3 * value, f"{name}_deg": degrees(value)}
        values |= {unit: _Number(number) for unit, number in units.items()}
    try:
        return SENTENCES.get(end.outcome, "{text}").format_map(values)
    except (LookupError, ValueError):
        shown = {name: f"{value:.4g}" for name, value in numbers.items()}
        known = (f"{name} {value}" for name, value in (dict(end.evidence) | shown).items())
        return ", ".join((end.outcome, *known))
