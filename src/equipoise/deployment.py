"""Deploy: a policy runs once, under conditions that it does not know, and is written down.

This is the simulated plant of the training, *not* a robot and *not* a digital twin of one: the arm
tracks its commands without delay, play or flexing, and the state is known without a sensor. Only
the pendulum's I and b, the noise and the start are unknown to the policy, drawn as for one test
trial from a seed of their own. What it shows is that the file of a policy, run tick by tick from
Python, does what the compiled trials of `equipoise.evaluation` said.
"""

from typing import Final

import numpy as np

from equipoise.control.boxes import box_index, boxes
from equipoise.control.policy import TabularPolicy
from equipoise.learning.closed_loop import CAUSES, make_plant, scaled
from equipoise.learning.trials import draw_trials, record_trial
from equipoise.model.pendulum import PendulumParameters
from equipoise.model.random import DEPLOYMENT
from equipoise.runlog import RunConditions, RunLog
from equipoise.settings import Settings

WORLD: Final = "model"
"""The training plant, as evaluations name it."""


def deploy(
    policy: TabularPolicy,
    *,
    seed: int = 0,
    duration: float | None = None,
    settings: Settings | None = None,
) -> RunLog:
    """Run a policy once on the simulated plant of its training.

    Args:
        policy: The policy; only its `act(state) -> u` decides.
        seed: Master seed of what the policy does not know: I and b, noise, start.
        duration: How long the run shall last [s]; that of an evaluation's trial if not given.
        settings: Noise of the plant, ranges of the start; the policy's own if not given.

    Returns:
        The run, to its end or its failure.

    Raises:
        ArmError: Home is a singular posture.
    """
    settings = policy.settings if settings is None else settings
    duration = settings.evaluation.duration if duration is None else duration
    plant = make_plant(policy.arm, settings, policy.h)
    trial = draw_trials(1, settings, seed, DEPLOYMENT, spread=1.0)
    nominal = policy.pendulum.parameters(linearised=settings.plant.linearised)
    real: PendulumParameters = scaled(
        nominal, float(trial.inertia_factor[0]), float(trial.friction_factor[0])
    )
    longest = round(duration / plant.h)
    cause, rows = record_trial(plant, policy, real, trial.start[0], longest, seed, DEPLOYMENT)
    arm, partition = policy.arm, boxes()
    joints = len(arm.joints)
    moving = list(arm.without_held(range(joints)))
    q, dq = np.tile(np.array(arm.home), (len(rows.u), 1)), np.zeros((len(rows.u), joints))
    q[:, moving], dq[:, moving] = rows.q, rows.dq
    x, x_dot, phi, phi_dot = (float(value) for value in trial.start[0])
    return RunLog(
        conditions=RunConditions(
            policy=policy.digest,
            world=WORLD,
            arm=arm.name,
            joints=tuple(joint.name for joint in arm.joints),
            held_joint=arm.held_joint,
            pendulum={
                name: float(getattr(real, name)) for name in ("w2", "k", "c", "coulomb", "drag")
            },
            start=(x, x_dot, phi, phi_dot),
            h=plant.h,
            duration=duration,
            seed=seed,
            settings=settings,
            cause=CAUSES[cause],
        ),
        time=np.arange(len(rows.u), dtype=np.float64) * plant.h,
        x=rows.state[:, 0],
        x_dot=rows.state[:, 1],
        phi=rows.state[:, 2],
        phi_dot=rows.state[:, 3],
        box=np.array([box_index(*row, boxes=partition) for row in rows.state.tolist()], np.int64),
        u=rows.u,
        tracked=rows.tracked,
        q=q,
        dq=dq,
    )
