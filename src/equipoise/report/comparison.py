"""The table *paper / reproduction*: each published number beside the measured one."""

from math import inf

import numpy as np

from equipoise import paper
from equipoise.control.boxes import COUNT
from equipoise.model.sim_configs import MODEL, TwinSettings
from equipoise.studies.formatting import LASTED, falls, how_it_ended, percent
from equipoise.studies.results import Results, truth


def comparison(results: Results) -> list[tuple[str, str, str, str]]:
    """Return the rows: quantity, section of the paper, the paper's value, ours."""
    policy, run, evaluation = results.policy, results.run, results.evaluation
    training_time = sum(s.wall for s in results.record.stages if s.name == "train")
    summary, shown = evaluation.results.summary(), truth(run)
    world = run.conditions.world
    where = "on the training plant" if world == MODEL else f"on the twin `{world}`"
    last = "" if run.cause == LASTED else "; a step before"
    return [
        (
            "Robot",
            "3, 4.3",
            "a real seven-joint arm",
            f"a simulated {policy.arm.name}, {where}",
        ),
        (
            "Period of the free swing",
            "3.2",
            f"around {paper.FREE_SWING_PERIOD:g} s",
            f"{results.pendulum.period:.4f} s",
        ),
        (
            "Table",
            "4.1",
            f"{COUNT} boxes × {len(paper.ACTIONS)} accelerations",
            f"{len(policy.Q)} boxes × {len(policy.actions)} accelerations, the same ones",
        ),
        (
            "Failure",
            "4.1",
            f"|φ| reaches {paper.PHI_LIMIT_DEG:g}° or |x| reaches {paper.X_LIMIT:g} m",
            "the same, or a joint exceeds its limits",
        ),
        ("Control period", "4.2", f"{paper.STEP:g} s", f"{policy.h:g} s"),
        (
            "Latency from command to motion",
            "4.2, 4.3",
            "no delay in simulation; not given for the robot",
            _latency(results),
        ),
        ("Training episodes", "4.2", f"{paper.EPISODES:,}", f"{policy.episodes:,}"),
        (
            "Training time",
            "4.4",
            "“few minutes”",
            f"{training_time:.3g} s for {policy.steps:,} steps, including compilation on a first "
            "run",
        ),
        ("Reported runs", "4.3", "one", f"{summary.trials} trials and one recorded run"),
        (
            "Balancing time",
            "4.3",
            f"{paper.SECONDS_BALANCED:g} s",
            f"{percent(summary.rate)} of the trials stood {evaluation.duration:g} s "
            f"(median {summary.median:.3g} s) on the training plant; the recorded run "
            f"{run.lasted:.3g} s, {where}",
        ),
        (
            f"Trials that stood at least {paper.SECONDS_BALANCED:g} s",
            "4.3",
            "one of one",
            percent(_share_above(results, paper.SECONDS_BALANCED)),
        ),
        (
            "End of the run",
            "4.3",
            f"x passed {paper.X_AT_FAILURE:g} m, at φ = {paper.PHI_AT_FAILURE_DEG:g}°",
            f"trials: {falls(summary.causes)}; the recorded run {how_it_ended(run.cause)}, "
            f"{run.lasted:g} s{last}, x = {shown.x[-1]:.3f} m, "
            f"φ = {np.rad2deg(shown.phi[-1]):.2f}°",
        ),
    ]


def _latency(results: Results) -> str:
    actuator, twin = results.policy.actuator, results.run.conditions.world_settings
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
    # A trial without a failure counts as infinitely long: the evaluation truncated it.
    stood = [
        inf if cause == LASTED else survival
        for survival, cause in zip(trials.survival, trials.causes, strict=True)
    ]
    return float(np.mean(np.array(stood) >= seconds))
