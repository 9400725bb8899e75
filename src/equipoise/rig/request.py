"""Request for a run on a rig: policy, rig and options, and what follows from them."""

from collections.abc import Callable
from dataclasses import dataclass
from math import inf, radians
from typing import Final

import numpy as np

from equipoise import paper
from equipoise.arrays import Array
from equipoise.control.control_step import ControllerParams, horizon, make_controller_params
from equipoise.control.policy import TaskPolicy
from equipoise.identification.actuator import excitation
from equipoise.log.conditions import Reference, RunConditions
from equipoise.model.actuator import Actuator
from equipoise.model.pendulum import PendulumParameters
from equipoise.outcomes import Phase
from equipoise.rig.config import RigSettings
from equipoise.safety.rules import SafetyParams, make_safety_params
from equipoise.settings import Start, changed
from equipoise.simulation.evaluation import Summary, evaluate

TRIALS: Final = 20
"""Number of simulated trials that judge a policy for a rig."""


@dataclass(frozen=True)
class RunRequest:
    """Policy, rig and options of a run."""

    policy: TaskPolicy
    """The policy."""
    actuator: Actuator
    """Identified response of the rig's arm."""
    settings: RigSettings
    """Contents of `rig.toml`."""
    robot: str
    """Address of the robot."""
    encoder: str | None
    """Address of the encoder; None where the robot's address includes one."""
    duration: float
    """Length of the balancing [s]."""
    max_speed: float | None = None
    """Flange speed at which the run stops [m/s]; None without one."""
    dry_run: bool = False
    """Whether the run ends before the arm moves."""
    seed: int = 0
    """Seed of an emulated rig."""
    identify: Callable[[Array, Array], Actuator] | None = None
    """Identification of the arm from an excitation before the lift, such as
    `equipoise.identification.actuator.identify_actuator`; None without one."""

    start: Start = "hand"
    """Start: the operator lifts the pendulum, or it hangs, and the arm swings it up."""
    runs: int = 1
    """Number of runs in a row, without a hand in between; more than one only from hanging."""
    reference: Reference | None = None
    """Reference from the first run of a series; None where the operator references the pendulum."""

    @property
    def pendulum(self) -> PendulumParameters:
        """Parameters of the pendulum that the controller assumes."""
        return self.policy.pendulum.parameters(linearised=self.policy.settings.plant.linearised)

    def parameters(self, actuator: Actuator) -> tuple[ControllerParams, SafetyParams]:
        """Return the constants of the control step with an actuator, and the safety limits.

        Raises:
            ArmError: Home is a singular posture.
            SettingsError: The delay exceeds the controller's history.
        """
        rig, policy, arm = self.settings, self.policy, self.settings.described_arm
        h, counts = policy.h, rig.counts_per_rev
        params = make_controller_params(
            arm, policy.settings, actuator, self.pendulum, h=h, counts_per_rev=counts
        )
        safety = make_safety_params(
            arm,
            reaction=horizon(arm, actuator, 0.0),
            h=h,
            speed=self.max_speed or inf,
            margin=radians(rig.position_margin_deg),
            speed_fraction=rig.speed_fraction,
            torque_fraction=rig.torque_fraction,
        )
        return params, safety

    def excitation(self) -> Array:
        """Return the motion that identifies the arm, from home to home.

        Returns:
            All joints [rad], h / 2 apart, shape (m, joints); without rows where the run identifies
            nothing.

        Raises:
            ArmError: Home is too close to a limit of a joint.
        """
        arm = self.settings.described_arm
        if self.identify is None:
            return np.zeros((0, len(arm.joints)))
        free = excitation(arm, period=self.policy.h / 2.0)
        # A half: behind a servo that is 30 ms slower than assumed, the joints follow within
        # the limit of the following error.
        free = arm.home_free + 0.5 * (free - arm.home_free)
        return np.array([arm.with_held(q) for q in free])

    def conditions(self) -> RunConditions:
        """Return the run conditions for the log.

        Raises:
            SettingsError: The twin is unknown.
        """
        policy = self.policy
        return RunConditions(
            policy=policy.digest,
            policy_name=policy.name,
            world=self.robot,
            arm=self.settings.described_arm,
            pendulum=self.pendulum,
            pendulum_digest=policy.pendulum.digest,
            h=policy.h,
            duration=self.duration,
            seed=self.seed,
            actuator=self.actuator.digest,
            identifies=self.identify is not None,
            counts_per_rev=self.settings.counts_per_rev,
            settings=changed(policy.settings, {"evaluation.start": self.start}),
            u_max=paper.U_MAX,
            rig=self.settings.model_dump(mode="json"),
            encoder=self.encoder,
            max_speed=self.max_speed,
            reference=self.reference,
            dry_run=self.dry_run,
            phases=tuple(Phase),
        )


def actuator_fits(policy: TaskPolicy, actuator: Actuator) -> bool:
    """Return whether delay, lags and response times are within the spread of the training."""
    trained, plant = policy.actuator, policy.settings.plant
    if plant.ideal or trained.kind == "ideal" or actuator.kind != trained.kind:
        return False
    lags = zip(actuator.lags, trained.lags, strict=True)
    ratios = [lag.value / expected.value for lag, expected in lags if expected.value > 0.0]
    differences = [actuator.delay.value - trained.delay.value]
    for joint in range(len(trained.lags)):
        differences.append(actuator.response_time(joint) - trained.response_time(joint))
    slow = max(map(abs, differences)) > plant.delay_spread
    return not slow and all(abs(ratio - 1.0) <= plant.lag_spread for ratio in ratios)


def judge_response(policy: TaskPolicy, actuator: Actuator) -> tuple[str, bool]:
    """Return how an arm's response compares with that of the training, and whether a run may begin.

    Outside the spread of the training simulation decides: with this actuator in plant and
    controller every trial has to survive.
    """
    own, trained = (
        f"{response.kind} with a delay of {1e3 * response.delay.value:.1f} ms"
        for response in (actuator, policy.actuator)
    )
    evidence = f"{own}, trained for {trained}"
    if actuator_fits(policy, actuator):
        return evidence, True
    if actuator.kind == "ideal":
        return f"{evidence}; no robot follows at once", False
    survived = simulate_trials(policy, actuator, "hand", 10.0).survived  # [s]
    return f"{evidence}; {survived} of {TRIALS} trials survive in simulation", survived == TRIALS


def simulate_trials(
    policy: TaskPolicy,
    actuator: Actuator,
    start: Start,
    duration: float,
    max_speed: float | None = None,
) -> Summary:
    """Simulate trials of a policy with the response of a rig's arm.

    Args:
        policy: The policy.
        actuator: The response.
        start: Start of the trials.
        duration: Their duration [s].
        max_speed: Flange speed at which a trial stops [m/s]; None without one.

    Raises:
        InputError: A swing-up cannot end with the policy.
        SettingsError: The delay exceeds the controller's history; or a pendulum to be swung up is
            linearised.
    """
    numbers = {"start": start, "trials": TRIALS, "duration": duration}
    values = {f"evaluation.{name}": value for name, value in numbers.items()}
    if max_speed is not None:
        values["plant.max_speed"] = max_speed
    settings = changed(policy.settings, values)
    return evaluate(policy, settings, actuator=actuator, with_baselines=False).results.summary()
