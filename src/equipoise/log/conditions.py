"""Conditions of a run, which are known before it begins, and its end."""

from math import isfinite
from typing import Annotated, Any

from pydantic import BeforeValidator, Field

from equipoise.arm.arm import Arm
from equipoise.files import Count, Name, Number, Seed, Value
from equipoise.model.actuator import Actuator
from equipoise.model.pendulum import PendulumParameters
from equipoise.outcomes import EXIT_CODES, End, Outcome, Phase, describe
from equipoise.settings import Settings


def _storable(value: Any) -> Any:
    """Return evidence for a file: a truncated text, and a number that is not finite as text."""
    if isinstance(value, float) and not isfinite(value):
        return str(value)
    return value[:4096] if isinstance(value, str) else value


EvidenceValue = Annotated[float | str, BeforeValidator(_storable)]
"""Number or text of an end; a text may quote an exception of a custom policy."""


class Reference(Value):
    """Measurements of a rig at rest at home, which later runs of a series take from the first."""

    zero: Number
    """Encoder counts of the hanging pendulum."""
    torque: tuple[Number, ...] | None = None
    """External torques [N m]; None for a robot that reports none."""


class RunConditions(Value):
    """Place of a run, and all its settings."""

    policy: Name
    """Digest of the policy; empty for an excitation of the arm."""
    policy_name: Name = ""
    """Name of the policy: its file, module or baseline; empty if unknown."""
    world: Name
    """World of a simulated run, or address of the robot."""
    arm: Arm
    """The arm, with its home posture and the pendulum's place."""
    pendulum: PendulumParameters
    """Parameters of the pendulum: in simulation the true ones, on a rig those assumed by the
    controller."""
    pendulum_digest: Name = ""
    """Digest of the identified pendulum."""
    start: tuple[Number, Number, Number, Number] | None = None
    """x [m], x_dot [m/s], phi [rad], phi_dot [rad/s] at the release; None on a rig."""
    h: float = Field(ge=1e-4, le=1.0)
    """Time between ticks [s]."""
    duration: float = Field(ge=0.0, le=1e6)
    """Requested duration of the balancing [s]."""
    seed: Seed
    """Master seed of pendulum, start and noise of simulated parts."""
    actuator: Name
    """Digest of the actuator assumed by the controller, or `ideal`."""
    identifies: bool = False
    """Whether an excitation before the lift identifies the actuator of the controller."""
    counts_per_rev: int | None = Field(ge=1, le=2**24)
    """Encoder counts per revolution; None without an encoder."""
    world_settings: dict[str, float | int | str | tuple[float, ...] | None] | None = None
    """Resolved parameters of the digital twin; None elsewhere."""
    zero_error: Number | None = None
    """True error of the encoder's zero [rad]; None without an encoder, and on a rig."""
    settings: Settings
    """Resolved settings of the policy: gains, noise, ranges of the start."""
    u_max: float | None = Field(default=None, gt=0.0, le=100.0)
    """Largest acceleration of the policy [m/s^2]; None in simulation."""
    rig: dict[str, Any] | None = None
    """Settings of the rig (`RigSettings`); None in simulation."""
    encoder: Name | None = None
    """Address of the encoder; None in simulation, or if the robot's address includes it."""
    max_speed: Number | None = None
    """Requested flange speed limit [m/s]; None without one."""
    reference: Reference | None = None
    """Reference from the first run of a series; None where this run takes its own."""
    dry_run: bool = False
    """Whether the run omitted the motion of the arm."""
    phases: tuple[Phase, ...] = Field(
        default=(Phase.BALANCING, Phase.SWINGING_UP), min_length=1, max_length=64
    )
    """Phases by their number in the ticks' column `state`."""

    @property
    def simulated(self) -> bool:
        """Whether the run is a simulation, which starts at the release, and not a run on a rig."""
        return self.rig is None

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints, from the base to the flange."""
        return tuple(joint.name for joint in self.arm.joints)


class RunEnd(Value):
    """End of a run."""

    outcome: Outcome = Outcome.ERROR
    """How it ended."""
    evidence: dict[Name, EvidenceValue] = Field(default_factory=dict, max_length=64)
    """Numbers and texts of the end (`equipoise.outcomes.Outcome.sentence`)."""
    survival: Number | None = None
    """Duration of the balancing [s]."""
    stoppable: bool = True
    """Whether software stopped the arm."""
    upright: Number | None = None
    """Duration of the swing-up before [s]; None for a start by hand."""
    zero: Number | None = None
    """Encoder counts of the hanging pendulum; None in simulation, and before the self-test."""
    zero_change: Number | None = None
    """Change of the zero that the self-test has measured [rad]; None without one."""
    w2: Number | None = None
    """w2 of the pendulum in the self-test [1/s^2]."""
    delay: Number | None = None
    """Delay of the encoder behind the measured joints in the self-test [s]."""
    max_speed: Number | None = None
    """Flange speed limit from the pre-flight [m/s]; None without one."""
    identified: Actuator | None = None
    """Actuator that an excitation before the lift identified; None without one."""
    missed: Count = 0
    """Number of skipped ticks."""
    lost_rows: Count = 0
    """Number of rows that full rings dropped."""

    @property
    def reason(self) -> str:
        """The end as a sentence."""
        return describe(End(self.outcome, self.evidence))

    @property
    def exit_code(self) -> int:
        """Exit code of the command that ran it."""
        return EXIT_CODES.get(self.outcome, 1) if self.stoppable else 3
