"""Results of a reproduction that nobody ran: small, quick to draw, as odd as a test wants them."""

from dataclasses import replace

import numpy as np

from equipoise import Trajectory, paper, resolve
from equipoise.control.policy import Checkpoint, LearningPoint, shipped_policy
from equipoise.files import Provenance
from equipoise.log.conditions import RunEnd
from equipoise.log.run_log import simulated_log
from equipoise.model.actuator import IDEAL_ACTUATOR, shipped_actuator
from equipoise.model.pendulum import Pendulum, SwingFit
from equipoise.model.worlds import IDEAL, MODEL, read_world
from equipoise.outcomes import Outcome
from equipoise.reproduction.results import RecipeResults, Results
from equipoise.simulation.evaluation import Evaluation, TrialResults
from tests.log.made_up import conditions

W2, C, RELEASE = 70.2, 0.15, 0.5
AHEAD = 0.03
"""How far the made-up policy sees ahead on the twin [s]."""
ZERO = -0.002
"""Error of the encoder's zero there [rad]."""
LITERAL_FALLS = (4.0, *9 * (30.0,))
"""Ends of the trials of the literal recipe in its simulation [s]."""
VERSIONS = {"equipoise": "1.2.3", "numpy": "2.0"}
PROVENANCE = Provenance(created="2031-02-03T04:05:06+00:00", command="reproduce", software=VERSIONS)


def swing(rate=False, source="swing.csv"):
    """A decaying cosine: near enough to a small swing to be drawn as one."""
    time = np.arange(0.0, 5.0, 0.005)
    free = time - RELEASE
    decay = np.where(free < 0.0, 1.0, np.exp(-0.5 * C * free))
    theta = 0.05 * decay * np.cos(np.sqrt(W2) * np.maximum(free, 0.0))
    if rate:
        return Trajectory(time=time, theta_dot=np.gradient(theta, time), source=source)
    return Trajectory(time=time, theta=theta, source=source)


def pendulum(trajectory, warnings=()):
    """What was identified from it."""
    fit = SwingFit(
        source=trajectory.source,
        sha256=trajectory.sha256,
        quantity="rate" if trajectory.theta is None else "angle",
        window=(RELEASE, 4.995),
        release=RELEASE,
        samples=900,
        periods=6.0,
        rms=2e-4,
        noise=1e-4,
        offset=0.0,
        theta=0.05,
        theta_dot=0.0,
        settings=resolve().identification,
        warnings=tuple(warnings),
    )
    return Pendulum.assumed(W2, C).model_copy(update={"fit": fit})


def policy(of, recipe="robust"):
    """A table that pushes towards where the pendulum leans, after a training with a selection."""
    settings = resolve(recipe)
    visits = np.ones((270, 8), dtype=np.int64)
    visits[:7] = 0
    lean = np.repeat([-1.0, 1.0], 135)
    shown = range(1000, 10001, 1000)
    curve = [LearningPoint(episodes=n, steps=40 * n, duration=n / 1000.0) for n in shown]
    found = {"trials": 400, "survived": 399, "mean_duration": 60.0, "rms_x": 0.05, "score": 0.9}
    candidates = [Checkpoint(episodes=n, **found) for n in (9000, 8000, 10000)]
    trained = {
        "Q": tuple(map(tuple, np.outer(lean, paper.ACTIONS).tolist())),
        "visits": tuple(map(tuple, visits.tolist())),
        "pendulum": of,
        "actuator": IDEAL_ACTUATOR if recipe == "paper" else shipped_actuator(),
        "settings": settings,
        "learning_curve": tuple(curve),
        "checkpoints": tuple(candidates) if settings.selection.every > 0 else (),
        "test": None,
    }
    return shipped_policy().model_copy(update=trained)


def trials(name, falls, count=20, cause=Outcome.TRACK):
    """Trials of a minute, of which the first fell after the given times."""
    return TrialResults(
        name=name,
        survival=(*falls, *[60.0] * (count - len(falls))),
        outcomes=(*[cause] * len(falls), *[Outcome.SURVIVED] * (count - len(falls))),
    )


def evaluation(of, falls=(3.0, 20.0)):
    """A policy that fell twice in twenty, and two yardsticks."""
    return Evaluation(
        policy=of.digest,
        world=MODEL,
        world_settings=None,
        actuator=of.actuator.digest,
        arm=of.arm.name,
        arm_digest=of.arm.digest,
        pendulum=of.pendulum.digest,
        settings=of.settings,
        seed=0,
        results=trials("policy", falls),
        baselines=(
            trials("LQR", ()),
            trials("random", np.linspace(0.2, 0.9, 20).tolist(), cause=Outcome.ANGLE),
        ),
    )


def twin_evaluation(of, falls=()):
    """The same policy on the twin, without baselines."""
    there = {"world": "twin:nominal", "world_settings": read_world("twin:nominal").settings}
    return evaluation(of, falls).model_copy(update={**there, "baselines": ()})


def run(of, survival=60.0, cause=Outcome.SURVIVED, world=MODEL):
    """A run of sines, with the boxes of a few states; on a twin the policy saw them early."""
    n = round(survival / 0.01)
    time = 0.01 * np.arange(n)
    q = np.tile(np.array(of.arm.home), (n, 1))
    q[:, 0] += 0.1 * np.sin(time)
    twin = world != MODEL

    def state(t):
        flange = {"x": 0.12 * np.sin(t), "x_dot": 0.12 * np.cos(t)}
        return flange | {"phi": 0.05 * np.sin(8.0 * t), "phi_dot": 0.4 * np.cos(8.0 * t)}

    was = state(time - AHEAD if twin else time)
    u = np.array(paper.ACTIONS)[np.arange(n) // 3 % 8]
    tick = {
        "time": time,
        **state(time),
        "box": np.arange(n) % 12 + 120,
        "u": u,
        "q": q,
        "dq": np.zeros_like(q),
        "estimated_phi": was["phi"],
        "estimated_phi_dot": was["phi_dot"],
        "bias": ZERO * (1.0 - np.exp(-time)) if twin else np.zeros(n),
    }
    truth = {"time": time, **was, "tracked": u + 0.03, "q": q - 0.001}
    true = {"w2": 68.0, "k": 6.93, "c": 0.17, "coulomb": 0.1, "drag": 0.0}
    given = {"policy": of.digest, "pendulum": true, "settings": of.settings, "zero_error": ZERO}
    if not twin:
        given |= {"world": world, "counts_per_rev": None, "world_settings": None}
        given |= {"actuator": IDEAL, "zero_error": None}
    end = RunEnd(outcome=cause, survival=survival)
    return simulated_log(conditions(**given), end, {"tick": tick, "truth": truth})


def swung_up(of, balanced=2.0, cause=Outcome.SURVIVED):
    """A run of 5 s whose pendulum turns from hanging to upright at a constant rate in 3 s."""
    made = run(of, survival=5.0, world="twin:nominal")
    turned = np.minimum(made.time, 3.0) / 3.0
    made.tables["truth"]["phi"] = (2.0 - turned) * np.pi % (2.0 * np.pi) - np.pi
    made.tables["truth"]["phi_dot"] = np.where(made.time < 3.0, -np.pi / 3.0, 0.0)
    made.tables["tick"]["state"] = made.time < 5.0 - balanced
    return replace(made, end=RunEnd(outcome=cause, survival=balanced))


def results(
    *, recipe="robust", given=None, warnings=(), falls=(3.0, 20.0), world="twin:nominal", **of_run
):
    """All of it. `given` is the name of a recording, where one was given."""
    trajectory = swing(source=given or "simulated swing")
    identified = pendulum(trajectory, warnings)
    trained, literal = policy(identified, recipe), policy(identified, "paper")
    twin = world != MODEL
    return Results(
        seed=0,
        simulated=not given,
        training_s=8.25,
        swing=trajectory,
        pendulum=identified,
        default=RecipeResults(
            policy=trained,
            evaluation=evaluation(trained, falls),
            twin_evaluation=twin_evaluation(trained) if twin else None,
            run=run(trained, world=world, **of_run),
        ),
        literal=RecipeResults(
            policy=literal,
            evaluation=evaluation(literal, LITERAL_FALLS),
            twin_evaluation=twin_evaluation(literal, 20 * (5.5,)) if twin else None,
            run=run(literal, survival=1.5, cause=Outcome.ANGLE, world=world),
        ),
        swing_up=swung_up(trained),
    )
