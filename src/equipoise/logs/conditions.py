"""Conditions of a run, known before it begins, and its end."""

from typing import Annotated, Any, Final, Literal, TypeAlias, get_args

from pydantic import BeforeValidator, Field, model_validator

from equipoise.artefacts import Count, Name, Number, Seed, Value
from equipoise.control.states import Phase
from equipoise.model.arms.arm import Arm
from equipoise.model.pendulum import PendulumParameters
from equipoise.settings import Settings

IDEAL: Final = "ideal"
"""Placeholder for the digest of an actuator: the arm follows its commands at once."""

LONGEST_TEXT: Final = 4096
"""Maximum length of a reason [characters]; longer ones are cut."""
Cut = Annotated[str, BeforeValidator(lambda text: text[:LONGEST_TEXT])]
"""Text of an error; it may quote what a guest's policy said."""
PendulumName: TypeAlias = Literal["w2", "k", "c", "coulomb", "drag"]


def named(pendulum: PendulumParameters) -> dict[PendulumName, float]:
    """Return the parameters of a pendulum by name, as conditions hold them."""
    return {name: float(getattr(pendulum, name)) for name in get_args(PendulumName)}


class RunConditions(Value):
    """Where a run took place, and everything that determined it."""

    policy: Name
    """Digest of the policy; empty where the arm was only excited."""
    policy_name: Name = ""
    """Name of the policy: its file, module or baseline; empty where unknown."""
    world: Name
    """World of a simulated run, or address of the robot."""
    arm: Arm
    """The arm, with its home posture and the pendulum's place."""
    pendulum: dict[PendulumName, Number] = Field(min_length=5)
    """Parameters w2 [1/s^2], k [1/m], c [1/s], coulomb [1/s^2], drag [1/rad]: in simulation those
    of the real pendulum, on a rig those that the controller assumes."""
    pendulum_digest: Name = ""
    """Digest of the identified pendulum."""
    friction: dict[str, float | str] | None = None
    """Dry friction and drag of the pendulum of a twin and their origin, by the names of
    `PivotFriction`; none elsewhere."""
    start: tuple[Number, Number, Number, Number] | None = None
    """x [m], x_dot [m/s], phi [rad], phi_dot [rad/s] at the release; none on a rig."""
    h: float = Field(ge=1e-4, le=1.0)
    """Time between ticks [s]."""
    duration: float = Field(ge=0.0, le=1e6)
    """Requested duration of the balancing [s]."""
    seed: Seed
    """Master seed of pendulum, start and noise of simulated parts."""
    actuator: Name
    """Digest of the actuator that the controller assumes, or `ideal`."""
    counts_per_rev: int | None = Field(ge=1, le=2**24)
    """Encoder counts per revolution; none where the angle is known without an encoder."""
    world_settings: dict[str, float | int | str | None] | None = None
    """Resolved parameters of the digital twin; none elsewhere."""
    zero_error: Number | None = None
    """Real error of the encoder's zero [rad]; none without an encoder, and on a rig."""
    settings: Settings
    """Resolved settings of the policy: gains, noise, ranges of the start."""
    u_max: float | None = Field(default=None, gt=0.0, le=100.0)
    """Largest acceleration of the policy [m/s^2]; none in simulation."""
    rig: dict[str, Any] | None = None
    """Settings of the rig (`RigSettings`); none in simulation."""
    encoder: Name | None = None
    """Address of the encoder; none in simulation, and where the robot's address has one."""
    t1: bool = False
    """Whether the speed limit of T1 held."""
    dry_run: bool = False
    """Whether everything was done but moving."""
    phases: tuple[Phase, ...] = Field(default=(Phase.BALANCING,), min_length=1, max_length=64)
    """Phases by their number in the ticks' column `state`."""

    @model_validator(mode="after")
    def _is_possible(self) -> "RunConditions":
        if Phase.BALANCING not in self.phases:
            raise ValueError("phases lacks 'balancing'")
        return self

    @property
    def simulated(self) -> bool:
        """Whether the run is a simulation from the release on; else a run on a rig."""
        return self.rig is None

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints, from the base to the flange."""
        return tuple(joint.name for joint in self.arm.joints)


class RunEnd(Value):
    """How a run ended."""

    cause: Name | None = None
    """Cause in a word or two: lasted, angle, track, operator, a safety rule; none where an error
    ended the program."""
    guard: Name = ""
    """Safety rule that ended a simulated run; empty where none did."""
    reason: Cut = ""
    """Cause in a sentence."""
    fault: Cut = ""
    """Error that ended the program."""
    lasted: Number | None = None
    """Duration of the balancing [s]."""
    stoppable: bool = True
    """Whether software commanded the arm to its rest."""
    zero: Number | None = None
    """Encoder counts at which the pendulum hangs; none in simulation, and before the self-test."""
    missed: Count = 0
    """Number of ticks that were left out."""
    late: dict[str, Number] = Field(default_factory=dict)
    """Percentiles p50, p99, p99.9 and maximum of the lateness of a tick [s]; empty in
    simulation."""
    compute: dict[str, Number] = Field(default_factory=dict)
    """The same percentiles of the computing time of a tick [s]."""
    lost_rows: Count = 0
    """Number of rows that the log lacks because a ring was full."""
