"""The table *paper / reproduction*: each published number beside the measured one."""

from collections.abc import Iterator

import numpy as np

from equipoise import paper
from equipoise.model.worlds import MODEL, TwinSettings
from equipoise.reproduction.results import Results, truth
from equipoise.settings import BoxSettings
from equipoise.worlds.formatting import LASTED, format_end, format_failures, percent


def comparison(results: Results) -> Iterator[tuple[str, str, str, str]]:
    """Return the rows: quantity, section of the paper, the paper's value, ours."""
    policy, run, evaluation = results.policy, results.run, results.evaluation
    summary, shown, world = evaluation.results.summary(), truth(run), run.conditions.world
    where = "on the training plant" if world == MODEL else f"on the twin `{world}`"
    seconds = f"{paper.SECONDS_BALANCED:g} s"
    yield "Robot", "3, 4.3", "a real seven-joint arm", f"a simulated {policy.arm.name}, {where}"
    published, ours = f"around {paper.FREE_SWING_PERIOD:g} s", f"{results.pendulum.period:.4f} s"
    yield "Period of the free swing", "3.2", published, ours
    published = f"{BoxSettings().count} boxes × {len(paper.ACTIONS)} accelerations"
    same = ", the same ones" if policy.settings.boxes.same_ends(BoxSettings()) else ""
    ours = f"{len(policy.Q)} boxes × {len(policy.actions)} accelerations{same}"
    yield "Table", "4.1", published, ours
    published = f"|φ| reaches {paper.PHI_LIMIT_DEG:g}° or |x| reaches {paper.X_LIMIT:g} m"
    yield "Failure", "4.1", published, "the same, or a joint exceeds its limits"
    yield "Control period", "4.2", f"{paper.STEP:g} s", f"{policy.h:g} s"
    published = "no delay in simulation; not given for the robot"
    yield "Latency from command to motion", "4.2, 4.3", published, _latency(results)
    yield "Training episodes", "4.2", f"{paper.EPISODES:,}", f"{policy.episodes:,}"
    wall = sum(stage.wall for stage in results.record.stages if stage.name == "train")
    ours = f"{wall:.3g} s for {policy.steps:,} steps, including compilation on a first run"
    yield "Training time", "4.4", "“few minutes”", ours
    yield "Reported runs", "4.3", "one", f"{summary.trials} trials and one recorded run"
    ours = (
        f"{percent(summary.rate)} of the trials stood {evaluation.duration:g} s (median "
        f"{summary.median:.3g} s) on the training plant; the recorded run {run.lasted:.3g} s, "
        f"{where}"
    )
    yield "Balancing time", "4.3", seconds, ours
    share = percent(_share_above(results, paper.SECONDS_BALANCED))
    yield f"Trials that stood at least {seconds}", "4.3", "one of one", share
    last = "" if run.cause == LASTED else "; a step before"
    ours = (
        f"trials: {format_failures(summary.causes)}; the recorded run {format_end(run.cause)}, "
        f"{run.lasted:g} s{last}, x = {shown.x[-1]:.3f} m, φ = {np.rad2deg(shown.phi[-1]):.2f}°"
    )
    published = f"x passed {paper.X_AT_FAILURE:g} m, at φ = {paper.PHI_AT_FAILURE_DEG:g}°"
    yield "End of the run", "4.3", published, ours


def _latency(results: Results) -> str:
    actuator, twin = results.policy.actuator, results.run.conditions.world_settings
    training = f"{1e3 * actuator.delay.value:.1f} ms and the servo's lag in training, as identified"
    if actuator.kind == "ideal":
        training = "no delay in training"
    if twin is None:
        return training
    transport = TwinSettings.model_validate(twin).transport
    return f"{training}; {1e3 * transport:g} ms and a servo on the twin"


def _share_above(results: Results, seconds: float) -> float:
    trials = results.evaluation.results
    # A trial without a failure counts as infinitely long: the evaluation truncated it.
    ends = zip(trials.survival, trials.causes, strict=True)
    return float(np.mean([survival >= seconds or cause == LASTED for survival, cause in ends]))
