"""The table *paper / here*: each published number beside what was measured."""

from math import inf
from typing import NamedTuple

import numpy as np

from equipoise import paper
from equipoise.control.boxes import COUNT
from equipoise.evaluation import Summary
from equipoise.logs.run_log import RunLog
from equipoise.model.sim_configs import MODEL, TwinSettings
from equipoise.studies.formatting import LASTED, falls, how_it_ended, percent
from equipoise.studies.results import Results, truth


class Row(NamedTuple):
    """One line of the table."""

    what: str
    """What is compared."""
    section: str
    """Where the paper says it."""
    paper: str
    """What the paper says."""
    here: str
    """What was found here."""


def comparison(results: Results) -> list[Row]:
    """Return the rows of the table."""
    policy, pendulum = results.policy, results.pendulum
    trained = sum(s.wall for s in results.record.stages if s.name == "train")
    summary = results.evaluation.results.summary()
    return [
        Row(
            "What moves",
            "3, 4.3",
            "a real arm of seven joints",
            f"a simulated {policy.arm.name}, {_where(results)}",
        ),
        Row(
            "Period of the free swing",
            "3.2",
            f"around {paper.FREE_SWING_PERIOD:g} s",
            f"{pendulum.period:.4f} s",
        ),
        Row(
            "Table",
            "4.1",
            f"{COUNT} boxes × {len(paper.ACTIONS)} accelerations",
            f"{len(policy.Q)} boxes × {len(policy.actions)} accelerations, the same ones",
        ),
        Row(
            "Failure",
            "4.1",
            f"|φ| reaches {paper.PHI_LIMIT_DEG:g}° or |x| reaches {paper.X_LIMIT:g} m",
            "the same; and if a joint leaves its limits",
        ),
        Row("Time between decisions", "4.2", f"{paper.STEP:g} s", f"{policy.h:g} s"),
        Row(
            "Between command and motion",
            "4.2, 4.3",
            "no delay in simulation; that of the robot is not given",
            _latency(results),
        ),
        Row("Episodes of training", "4.2", f"{paper.EPISODES:,}", f"{policy.episodes:,}"),
        Row(
            "Time that training took",
            "4.4",
            "“few minutes”",
            f"{trained:.3g} s for {policy.steps:,} steps, compilation on a first run included",
        ),
        Row("Runs that are told of", "4.3", "one", f"{summary.trials} trials and one recorded run"),
        Row(
            "How long it stood",
            "4.3",
            f"{paper.SECONDS_BALANCED:g} s",
            f"{percent(summary.rate)} of the trials stood {results.evaluation.duration:g} s "
            f"(median {summary.median:.3g} s) on the plant of the training; the recorded run "
            f"{results.run.lasted:.3g} s, {_where(results)}",
        ),
        Row(
            f"Trials that stood {paper.SECONDS_BALANCED:g} s and more",
            "4.3",
            "one of one",
            percent(_share_above(results, paper.SECONDS_BALANCED)),
        ),
        Row(
            "How it ended",
            "4.3",
            f"x passed {paper.X_AT_FAILURE:g} m, at φ = {paper.PHI_AT_FAILURE_DEG:g}°",
            _ends(summary, results.run),
        ),
    ]


def _where(results: Results) -> str:
    world = results.run.conditions.world
    return "on the plant of the training" if world == MODEL else f"on the twin `{world}`"


def _latency(results: Results) -> str:
    policy, twin = results.policy, results.run.conditions.world_settings
    actuator = policy.actuator
    training = (
        "no delay in training"
        if actuator.kind == "ideal"
        else f"{1e3 * actuator.delay.value:.1f} ms and the servo's lag in training, as identified"
    )
    if twin is None:
        return training
    transport = TwinSettings.model_validate(twin).transport
    return f"{training}; {1e3 * transport:g} ms and a servo on the twin"


def _share_above(results: Results, seconds: float) -> float:
    trials = results.evaluation.results
    # A trial that lasted would have gone on.
    stood = [
        inf if cause == LASTED else survival
        for survival, cause in zip(trials.survival, trials.causes, strict=True)
    ]
    return float(np.mean(np.array(stood) >= seconds))


def _ends(summary: Summary, run: RunLog) -> str:
    shown = truth(run)
    state = f"x = {shown.x[-1]:.3f} m, φ = {np.rad2deg(shown.phi[-1]):.2f}°"
    last = "" if run.cause == LASTED else "; a step before"
    end = f"{how_it_ended(run.cause)}, {run.lasted:g} s{last}, {state}"
    return f"trials: {falls(summary.causes)}; the recorded run {end}"
