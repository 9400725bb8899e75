"""The report from the trained policy on: the table, its trials, one run."""

from collections.abc import Iterator

import numpy as np

from equipoise import paper
from equipoise.evaluation import Evaluation, TrialResults
from equipoise.report.markup import Part, Pictures, paragraph, part, picture, table
from equipoise.studies.results import Results, falls, how_it_ended, percent


def outcome(results: Results, pictures: Pictures) -> Iterator[Part]:
    """Return the sections from the trained policy on."""
    yield _policy(pictures)
    yield _evaluation(results, pictures)
    yield _deployment(results, pictures)


def _policy(pictures: Pictures) -> Part:
    return part(
        "policy",
        "What was learned",
        paragraph(
            "This is all there is to the policy: a number for each box. In each panel the lean of "
            "the pendulum runs from left to right, its rate of fall from bottom to top. Where it "
            "leans right and falls right, in the upper right corner, the flange has to hurry to "
            "the right to get below it: light. The lower left corner is its mirror image."
        ),
        paragraph(
            "The columns are the track. Coming back from its right end takes a detour: first "
            "further to the right, until the pendulum leans left, then follow it home. So near "
            "upright the right column should push right, where the left column pushes left. The "
            "middle row is where a good policy lives; it seldom gets to the outer rows, and what "
            "the table says there is rough."
        ),
        picture(
            pictures["policy"],
            "The 270 boxes. Hatched boxes were never visited in training, and their entry means "
            "nothing. Framed boxes are those that the recorded run below went through.",
            "Commanded acceleration in each of the 270 boxes, as a grid of coloured numbers",
        ),
    )


def _evaluation(results: Results, pictures: Pictures) -> Part:
    evaluation = results.evaluation
    e, plant = evaluation.settings.evaluation, evaluation.settings.plant
    phi, phi_dot = (
        f"{np.rad2deg(low):.3g}° to {np.rad2deg(high):.3g}°"
        for low, high in ((e.phi_low, e.phi_high), (e.phi_dot_low, e.phi_dot_high))
    )
    return part(
        "evaluation",
        "How long it stands",
        paragraph(
            "Each trial starts as a hand leaves the pendulum: the flange at rest in the middle, "
            f"the pendulum leaning {phi} and falling outwards at {phi_dot} a second. Its I varies "
            f"by {percent(plant.inertia_sigma)} around the value that the policy was trained for "
            f"and its b by {percent(plant.friction_sigma)} (standard deviations), with noise in "
            "every step. Starts and seeds appear nowhere else."
        ),
        picture(
            pictures["survival"],
            "On the left, time is logarithmic. LQR knows the model and commands any acceleration "
            "within the range; snapped, it has to take one of the table's eight. PD keeps the "
            "pendulum up but does not know where the track ends. Random picks any of the eight.",
            "Share of the trials still standing against time, for the policy and the yardsticks",
        ),
        _outcomes(evaluation),
    )


def _outcomes(evaluation: Evaluation) -> str:
    def row(results: TrialResults) -> list[str]:
        s = results.summary()
        low, high = s.interval
        return [
            results.name,
            f"{s.survived} of {s.trials}",
            f"{percent(low)} to {percent(high)}",
            f"{s.median:.3g} s",
            f"{s.quantiles[0]:.3g} s",
            falls(s.causes),
        ]

    return table(
        (
            "",
            f"stood {evaluation.duration:g} s",
            "95 % interval",
            "median",
            "19 of 20 stood",
            "what failed",
        ),
        [row(results) for results in (evaluation.results, *evaluation.yardsticks)],
        caption="Intervals are exact (Clopper-Pearson).",
    )


def _deployment(results: Results, pictures: Pictures) -> Part:
    run, trained = results.run, results.pendulum.parameters()
    real = run.conditions.pendulum
    x, x_dot, phi, phi_dot = run.conditions.start
    rows = [
        ("w2 [1/s²]", f"{trained.w2:.2f}", f"{real['w2']:.2f}"),
        ("k [1/m]", f"{trained.k:.3f}", f"{real['k']:.3f}"),
        ("c [1/s]", f"{trained.c:.4f}", f"{real['c']:.4f}"),
        (
            "start",
            "unknown",
            f"x = {x:g} m, dx/dt = {x_dot:g} m/s, φ = {np.rad2deg(phi):.2f}°, "
            f"dφ/dt = {np.rad2deg(phi_dot):.1f}°/s",
        ),
        ("end", "", f"{how_it_ended(run.conditions.cause)}, {run.lasted:g} s"),
    ]
    fault = "the simulated plant of the training stands in for the robot"
    return part(
        "deployment",
        "One run, as the paper shows it",
        paragraph(
            f"The paper shows {paper.SECONDS_BALANCED:g} s on the real arm in its figures 4 to 7. "
            f"Here {fault}, with a pendulum that differs from the one that the policy was trained "
            "for:"
        ),
        table(("", "the policy was trained for", "the run had"), rows),
        picture(
            pictures["figure-4-commands"],
            "The paper's figure 4. There is no zero among the eight accelerations, so standing "
            "still means switching to and fro.",
            "Commanded acceleration of the flange against time",
        ),
        picture(
            pictures["figure-5-joints"],
            "The paper's figure 5. The joint that is held stays where it is; of the others, those "
            "that turn about a vertical axis at home do most of the work.",
            "Positions of the joints against time",
        ),
        picture(
            pictures["figure-6-pendulum"],
            "The paper's figure 6. Dotted lines are the edges of the boxes: between them the table "
            "sees no difference.",
            "Angle and angular velocity of the pendulum against time",
        ),
        picture(
            pictures["figure-7-flange"],
            f"The paper's figure 7. There, x passed {paper.X_AT_FAILURE:g} m after "
            f"{paper.SECONDS_BALANCED:g} s.",
            "Displacement and velocity of the flange against time",
        ),
    )
