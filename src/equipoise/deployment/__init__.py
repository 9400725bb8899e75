"""Deploy: a policy runs once, under conditions that it does not know, and is written down.

It runs on the training plant (world `model`) or on a digital twin of the rig (`twin:...`): an arm
behind the robot's own servo, a pendulum that pulls at it, an encoder with a wrong zero. What the
policy does not know (pendulum, noise, start, zero) is drawn as for one test trial, from a seed of
its own. On the model any object with `act(state) -> u` would do: the file of a policy, run tick by
tick from Python, does what the compiled trials of `equipoise.evaluation` said.

`excite` moves the arm instead, the pendulum hanging, and writes down how it follows: what
`equipoise.identification.actuator` identifies the actuator from.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from equipoise import paper
from equipoise.control.boxes import box_index, boxes, cause_named
from equipoise.control.control_step import SETPOINTS_PER_TICK, make_controller_params
from equipoise.control.policy import TabularPolicy
from equipoise.control.trial_safety import guard_named, trial_safety
from equipoise.learning.closed_loop import (
    make_loop_params,
    scaled,
)
from equipoise.learning.trials import draw_trials, record_trial, twin_settings
from equipoise.model.actuator import Actuator
from equipoise.model.arms.arm import FREE_JOINTS, Arm
from equipoise.model.pendulum import Pendulum, PendulumParameters
from equipoise.model.random import DEPLOYMENT
from equipoise.model.sim_configs import MODEL, World, pivot_friction, read_world
from equipoise.runlog import (
    IDEAL,
    EncoderSamples,
    Replies,
    RunConditions,
    RunLog,
    Stream,
    TruthColumns,
)
from equipoise.settings import Settings

Array = npt.NDArray[np.float64]

EXCITED = "excited"
"""Cause of the end of a run that moved the arm only."""


def deploy(
    policy: TabularPolicy,
    *,
    world: str | World = MODEL,
    actuator: Actuator | None = None,
    seed: int = 0,
    duration: float | None = None,
    settings: Settings | None = None,
) -> RunLog:
    """Run a policy once.

    Args:
        policy: The policy.
        world: `model`, a name that `read_world` knows, or a twin with its numbers.
        actuator: What the controller knows of the arm's response; that of the training if not
            given.
        seed: Master seed of what the policy does not know.
        duration: How long the run shall last [s]; that of an evaluation's trial if not given.
        settings: Noise of the plant, ranges of the start, the controller; the policy's own if not
            given.

    Returns:
        The run, to its end or its failure.

    Raises:
        ArmError: Home is a singular posture, or a twin does not know the masses of the arm.
        SettingsError: There is no such world.
    """
    settings = policy.settings if settings is None else settings
    actuator = policy.actuator if actuator is None else actuator
    duration = settings.evaluation.duration if duration is None else duration
    if isinstance(world, str) and world == MODEL:
        return _on_the_model(policy, actuator, seed, duration, settings)
    twin = world if isinstance(world, World) else read_world(world)
    return _on_a_twin(policy, twin, actuator, seed, duration, settings)


def excite(
    arm: Arm, world: str | World, pendulum: Pendulum, *, seed: int = 0, duration: float = 10.0
) -> RunLog:
    """Move every joint of a twin about home, the pendulum hanging, and record how it follows.

    Args:
        arm: An iiwa with its home posture.
        world: A name that `read_world` knows, or a twin with its numbers.
        pendulum: The pendulum that hangs on it.
        seed: Master seed of jitter and noise.
        duration: Length of the record [s].

    Returns:
        A run without ticks: setpoints, measured joints and encoder counts.

    Raises:
        ArmError: The masses of the arm are not known, or home is close to a limit.
        SettingsError: There is no such world.
    """
    from equipoise.devices.twin import excitation

    twin = world if isinstance(world, World) else read_world(world)
    friction = pivot_friction(pendulum, twin.settings)
    parameters = friction.on(pendulum.parameters())
    record = excitation.excite(arm, twin.settings, parameters, seed, duration)
    return RunLog.of_excitation(
        _conditions(
            arm,
            parameters,
            Settings(),
            policy="",
            world=twin.name,
            start=(0.0, 0.0, np.pi, 0.0),
            h=paper.STEP,
            duration=duration,
            seed=seed,
            actuator="",
            twin=twin,
            friction=friction.model_dump(),
            zero_error=None,
            cause=EXCITED,
        ),
        Stream(record.stream_time, _all_joints(arm, record.stream_q)),
        Replies(record.reply_time, _all_joints(arm, record.reply_q)),
    )


def _on_the_model(
    policy: TabularPolicy, actuator: Actuator, seed: int, duration: float, settings: Settings
) -> RunLog:
    nominal = policy.pendulum.parameters(linearised=settings.plant.linearised)
    plant = make_loop_params(policy.arm, settings, policy.h, nominal, actuator)
    trials = draw_trials(1, settings, seed, DEPLOYMENT, spread=1.0)
    longest = round(duration / policy.h)
    cause, rows = record_trial(plant, policy, nominal, trials, 0, longest, seed, DEPLOYMENT)
    real = scaled(nominal, float(trials.inertia_factor[0]), float(trials.friction_factor[0]))
    arm, q, truth = policy.arm, _all_joints(policy.arm, rows.q), rows.state.T
    return RunLog(
        conditions=_conditions(
            arm,
            real,
            settings,
            policy=policy.digest,
            world=MODEL,
            start=trials.start[0],
            h=policy.h,
            duration=duration,
            seed=seed,
            actuator=_named(actuator),
            twin=None,
            zero_error=float(trials.zero[0]) if plant.controller.has_sensor else None,
            cause=cause_named(cause),
            guard=guard_named(cause),
        ),
        tracked=rows.tracked,
        q=q,
        dq=_rates_of_all_joints(arm, rows.dq),
        # Each tick begins where the joints were at the end of the one before.
        truth=TruthColumns(*truth, q=np.vstack((arm.home, _all_joints(arm, rows.arm_q)))[: len(q)]),
        **_decisions(rows.observation, rows.u, rows.estimate, policy.h),
    )


def _on_a_twin(
    policy: TabularPolicy,
    world: World,
    actuator: Actuator,
    seed: int,
    duration: float,
    settings: Settings,
) -> RunLog:
    from equipoise.devices.twin.trial import record_trial as record

    nominal = policy.pendulum.parameters(linearised=settings.plant.linearised)
    there = twin_settings(settings, world.settings)
    trials = draw_trials(1, there, seed, DEPLOYMENT, spread=1.0)
    friction = pivot_friction(policy.pendulum, world.settings)
    real = friction.on(
        PendulumParameters(
            *scaled(nominal, float(trials.inertia_factor[0]), float(trials.friction_factor[0]))
        )
    )
    controller = make_controller_params(
        policy.arm,
        settings,
        actuator,
        nominal,
        h=policy.h,
        counts_per_rev=world.settings.counts_per_rev,
    )
    outcome, rows, zero = record(
        policy.arm,
        world.settings,
        controller,
        policy.kernel,
        real,
        phi=float(trials.start[0, 2]),
        phi_dot=float(trials.start[0, 3]),
        duration=duration,
        seed=seed,
        guard=trial_safety(
            policy.arm,
            world.settings,
            actuator,
            policy.kernel,
            policy.h,
            settings.plant.max_speed,
        ),
    )
    arm, h, x_dot = policy.arm, policy.h, rows.truth[:, 1]
    time = np.arange(len(rows.u)) * h
    sent = (time[:, None] + np.arange(SETPOINTS_PER_TICK) * h / SETPOINTS_PER_TICK).ravel()
    setpoints = rows.setpoints.reshape(-1, FREE_JOINTS)
    return RunLog(
        conditions=_conditions(
            arm,
            real,
            settings,
            policy=policy.digest,
            world=world.name,
            start=trials.start[0],
            h=h,
            duration=duration,
            seed=seed,
            actuator=_named(actuator),
            twin=world,
            friction=friction.model_dump(),
            zero_error=zero,
            cause=cause_named(outcome.cause),
            guard=guard_named(outcome.cause),
        ),
        tracked=np.diff(x_dot, append=x_dot[-1:]) / h,
        q=_all_joints(arm, rows.command[:, :FREE_JOINTS]),
        dq=_rates_of_all_joints(arm, rows.command[:, FREE_JOINTS:]),
        truth=TruthColumns(*rows.truth.T, q=rows.q),
        stream=Stream(sent, _all_joints(arm, setpoints)),
        replies=Replies(rows.measured[:, -1], _all_joints(arm, rows.measured[:, :-1])),
        encoder=EncoderSamples(rows.counts[:, 1], rows.counts[:, 0].astype(np.int64)),
        **_decisions(rows.observation, rows.u, rows.estimate, h),
    )


def _decisions(seen: Array, u: Array, estimate: Array, h: float) -> Mapping[str, Any]:
    """Return the columns of a run log that say what was seen and decided in each tick."""
    partition = boxes()
    return {
        "time": np.arange(len(u), dtype=np.float64) * h,
        "x": seen[:, 0],
        "x_dot": seen[:, 1],
        "phi": seen[:, 2],
        "phi_dot": seen[:, 3],
        "box": np.array([box_index(*row, boxes=partition) for row in seen.tolist()], np.int64),
        "u": u,
        "estimated_phi": estimate[:, 0],
        "estimated_phi_dot": estimate[:, 1],
        "bias": estimate[:, 2],
    }


def _named(actuator: Actuator) -> str:
    return IDEAL if actuator.kind == "ideal" else actuator.digest


def _conditions(
    arm: Arm,
    pendulum: PendulumParameters,
    settings: Settings,
    *,
    start: Any,
    twin: World | None,
    **told: Any,
) -> RunConditions:
    x, x_dot, phi, phi_dot = (float(value) for value in start)
    names = ("w2", "k", "c", "coulomb", "drag")
    return RunConditions(
        arm=arm.name,
        joints=tuple(joint.name for joint in arm.joints),
        held_joint=arm.held_joint,
        pendulum={name: float(getattr(pendulum, name)) for name in names},
        start=(x, x_dot, phi, phi_dot),
        counts_per_rev=None if twin is None else twin.settings.counts_per_rev,
        world_settings=None if twin is None else twin.settings.model_dump(),
        settings=settings,
        **told,
    )


def _all_joints(arm: Arm, free: Array) -> Array:
    """Return postures of all joints [rad], shape (n, joints), from those of the free ones."""
    q = np.tile(np.array(arm.home), (len(free), 1))
    q[:, list(arm.free)] = free
    return q


def _rates_of_all_joints(arm: Arm, free: Array) -> Array:
    """Return the same of their velocities [rad/s]: a joint that is held has none."""
    dq = np.zeros((len(free), len(arm.joints)))
    dq[:, list(arm.free)] = free
    return dq
