"""One simulated run of a policy, and its log.

The world is a plant (`ideal`, `model`) or a digital twin of the rig (`twin:...`): an arm with the
robot's servo, a pendulum whose weight loads it, an encoder with a zero offset. Pendulum, noise,
start and zero are drawn as for a test trial, from a separate seed. The policy runs tick by tick
from Python, with the same bits as a compiled trial.

`excite` moves the arm while the pendulum hangs, and records the response for the identification of
the actuator (`equipoise.identification.actuator`).
"""

from typing import Any

import numpy as np

from equipoise import paper
from equipoise.arguments import Duration, checked
from equipoise.arm.arm import FREE_JOINTS, Arm
from equipoise.arm.urdf import read_arm
from equipoise.arrays import Array
from equipoise.control.bound_policy import AnyPolicy, read_policy
from equipoise.control.control_step import SETPOINTS_PER_TICK
from equipoise.control.ticks import TickRecord
from equipoise.files import Seed, StrPath
from equipoise.log.conditions import RunConditions, RunEnd
from equipoise.log.run_log import RunLog, simulated_log
from equipoise.model.actuator import Actuator
from equipoise.model.grid import NOT_UPRIGHT, TRUNCATED, box_indices, make_grid
from equipoise.model.pendulum import Pendulum, read_pendulum
from equipoise.model.random import DEPLOYMENT
from equipoise.model.worlds import IDEAL, MODEL, World, pendulum_on, read_world
from equipoise.outcomes import TRIAL_OUTCOMES, Outcome
from equipoise.settings import Settings
from equipoise.simulation import TrialRecorder, run_trial, setup_of, simulate


@checked
def simulate_run(
    policy: AnyPolicy = None,
    *,
    world: str | World = MODEL,
    actuator: Actuator | StrPath | None = None,
    seed: Seed = 0,
    duration: Duration | None = None,
    settings: Settings | None = None,
) -> RunLog:
    """Run a policy once.

    Args:
        policy: The policy; as in `evaluate`.
        world: `ideal`, `model`, a name that `read_world` knows, or a twin with its numbers.
        actuator: The controller's model of the arm's response (default: that of the training).
        seed: Master seed of pendulum, noise, start and zero.
        duration: Length of the run [s] (default: that of an evaluation's trial).
        settings: Noise of the plant, ranges of the start, the controller (default: the policy's).

    Returns:
        The log, to the end of the run or its failure.

    Raises:
        ArmError: Home is a singular posture, or the masses of a twin's arm are unknown.
        SettingsError: The world is unknown.
    """
    policy = read_policy(policy)
    setup = setup_of(policy, world, settings, actuator)
    pendulum, arm, settings, h = setup.pendulum, setup.arm, setup.settings, setup.h
    duration = settings.evaluation.duration if duration is None else duration
    simulation = simulate(world, setup, seed=seed, stream=DEPLOYMENT)
    trial, loop = simulation.draw(1).trial(0), simulation.loop()
    recorder, twin = TrialRecorder(), simulation.twin
    end = run_trial(loop, simulation.acting(policy, loop), trial, duration, recorder)
    rows = recorder.rows
    time = np.arange(len(rows.u), dtype=np.float64) * h
    sent = (time[:, None] + np.arange(SETPOINTS_PER_TICK) * h / SETPOINTS_PER_TICK).ravel()
    setpoints = rows.setpoints.reshape(-1, FREE_JOINTS)
    state = ("x", "x_dot", "phi", "phi_dot")
    evidence: dict[str, float | str] = {}
    if end.cause == NOT_UPRIGHT:
        evidence = {"value": end.upright * h}
    elif end.cause != TRUNCATED and len(rows.state):
        evidence = dict(zip(state, rows.state[-1].tolist(), strict=True))
    measured: dict[str, Any] = {}
    if twin is not None:
        joints, measured_at = _all_joints(arm, rows.measured[:, :-1]), rows.measured[:, -1]
        measured = {
            "stream": {"time": sent, "q": _all_joints(arm, setpoints)},
            "reply": {"time": measured_at, "sent": measured_at, "q": joints},
            "encoder": {"time": rows.encoder[:, 1], "counts": rows.encoder[:, 0]},
        }
    boxes = make_grid(settings.boxes, pendulum.parameters().k)
    box = box_indices(rows.observation, boxes)
    decided = (*rows.observation.T, box, rows.u, *rows.estimate.T)
    return simulated_log(
        RunConditions(
            arm=arm,
            settings=settings,
            policy=policy.digest,
            policy_name=policy.name,
            pendulum_digest=pendulum.digest,
            world=simulation.name,
            start=trial.start,
            h=h,
            duration=duration,
            seed=seed,
            actuator=IDEAL if setup.actuator.kind == "ideal" else setup.actuator.digest,
            zero_error=loop.zero,
            pendulum=loop.pendulum,
            counts_per_rev=twin and twin.counts_per_rev,
            world_settings=twin and twin.model_dump(),
        ),
        RunEnd(
            outcome=TRIAL_OUTCOMES[end.cause],
            evidence=evidence,
            survival=round(end.steps * h, 9),
            upright=round(end.upright * h, 9) if end.steps and end.upright else None,
        ),
        {
            "tick": {
                "time": time,
                "late": 0.0,
                "compute": 0.0,
                "state": np.arange(len(time)) < end.upright,  # swinging up, of the phases
                **dict(zip(TickRecord._fields, decided, strict=False)),
                "q": _all_joints(arm, rows.q),
                "dq": _all_joints(arm, rows.dq, held=0.0),
            },
            "truth": {
                "time": time,
                **dict(zip(state, rows.state.T, strict=True)),
                "tracked": rows.tracked,
                "q": rows.joints,
            },
            **measured,
        },
    )


@checked
def excite(
    arm: Arm | StrPath | None = None,
    world: str | World = "twin:nominal",
    pendulum: Pendulum | StrPath | None = None,
    *,
    seed: Seed = 0,
    duration: Duration = 10.0,
) -> RunLog:
    """Move every joint of a twin about home while the pendulum hangs, and record the response.

    Args:
        arm: The arm, its name or its URDF; by default the iiwa7.
        world: A name that `read_world` knows, or a twin with its numbers.
        pendulum: The hanging pendulum, or its file; by default the one that ships.
        seed: Master seed of jitter and noise.
        duration: Length of the record [s].

    Returns:
        A log without ticks: setpoints, measured joints, and the hanging pendulum's swing.

    Raises:
        ArmError: The masses of the arm are unknown, or home is close to a limit.
        SettingsError: The world is unknown.
    """
    from equipoise.identification.actuator import PERIOD, excitation
    from equipoise.simulation.twin.twin import Twin

    arm, pendulum = read_arm(arm), read_pendulum(pendulum)
    twin = world if isinstance(world, World) else read_world(world)
    parameters = pendulum_on(pendulum, twin.settings)
    simulated, sent = Twin(arm, parameters, twin.settings, seed=seed), excitation(arm, duration)
    rows: list[tuple[float, Array, float, float, float]] = []
    for q in sent:
        now = simulated.now
        simulated.send(q)
        simulated.advance(PERIOD)
        rows.append((now, *simulated.measured(), *simulated.encoder()))
    time, measured, measured_at, counts, counted_at = map(np.array, zip(*rows, strict=True))
    return simulated_log(
        RunConditions(
            arm=arm,
            settings=Settings(),
            policy="",
            world=twin.name,
            start=(0.0, 0.0, np.pi, 0.0),
            h=paper.STEP,
            duration=duration,
            seed=seed,
            actuator="",
            pendulum=parameters,
            pendulum_digest=pendulum.digest,
            counts_per_rev=twin.settings.counts_per_rev,
            world_settings=twin.settings.model_dump(),
        ),
        RunEnd(outcome=Outcome.EXCITED),
        {
            "stream": {"time": time, "q": _all_joints(arm, sent)},
            "reply": {"time": measured_at, "sent": measured_at, "q": _all_joints(arm, measured)},
            "encoder": {"time": counted_at, "counts": counts},
        },
    )


def _all_joints(arm: Arm, free: Array, held: float | None = None) -> Array:
    """Return values of all joints, shape (n, joints), from those of the free joints.

    Args:
        arm: The arm.
        free: Values of the free joints, shape (n, free joints).
        held: Value of the held joints (default: their angles at home [rad]).
    """
    values = np.full((len(free), len(arm.joints)), arm.home if held is None else held, np.float64)
    values[:, list(arm.free)] = free
    return values
