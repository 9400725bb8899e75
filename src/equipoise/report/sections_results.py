"""The report from the trained policy on: the table, its trials, one run, the gap to a robot."""

from collections.abc import Iterator

import numpy as np

from equipoise import paper
from equipoise.control.control_step import horizon
from equipoise.evaluation import Evaluation, TrialResults
from equipoise.model.sim_configs import MODEL, PivotFriction, TwinSettings
from equipoise.report.markup import (
    Part,
    Pictures,
    bullets,
    conclusion,
    paragraph,
    part,
    picture,
    table,
)
from equipoise.studies.formatting import falls, how_it_ended, percent
from equipoise.studies.results import Results, estimates_zero, no_gap, seen_otherwise


def sections_results(results: Results, pictures: Pictures) -> Iterator[Part]:
    """Return the sections from the trained policy on."""
    yield _policy(pictures)
    yield _evaluation(results, pictures)
    yield _deployment(results, pictures)
    yield _gap(results, pictures)


def _policy(pictures: Pictures) -> Part:
    return part(
        "policy",
        "What was learned",
        paragraph(
            "This is all there is to the policy: a number for each box. In each panel the lean of "
            "the pendulum runs from left to right, its rate of fall from bottom to top. Where it "
            "leans right and falls right, in the upper right corner, the flange has to hurry to "
            "the right to get below it: red. The lower left corner is its mirror image."
        ),
        paragraph(
            "The columns are the track. Coming back from its right end takes a detour: first "
            "further to the right, until the pendulum leans left, then follow it home. So near "
            "upright the right column should push right, where the left column pushes left. The "
            "middle row is where a good policy lives; it seldom gets to the outer rows, and what "
            "the table says there is rough."
        ),
        picture(
            pictures,
            "policy",
            "The 270 boxes: blue pushes left, red right. Hatched boxes were never visited in "
            "training, and their entry means nothing. Framed boxes are those that the recorded run "
            "below went through.",
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
            "First on the plant of the training, which is quick to compute. Each trial starts as "
            "a hand leaves the pendulum: the flange at rest in the middle, "
            f"the pendulum leaning {phi} and falling outwards at {phi_dot} a second. Its I varies "
            f"by {percent(plant.inertia_sigma)} around the value that the policy was trained for "
            f"and its b by {percent(plant.friction_sigma)} (standard deviations), with noise in "
            f"every step{_and_the_arm(evaluation)}. Starts and seeds appear nowhere else."
        ),
        picture(
            pictures,
            "survival",
            "On the left, time is logarithmic. LQR knows the model and commands any acceleration "
            "within the range; snapped, it has to take one of the table's eight. PD keeps the "
            "pendulum up but does not know where the track ends. Random picks any of the eight.",
            "Share of the trials still standing against time, for the policy and the yardsticks",
        ),
        _outcomes(evaluation),
    )


def _and_the_arm(evaluation: Evaluation) -> str:
    plant = evaluation.settings.plant
    if plant.ideal:
        return ""
    return (
        f"; the arm's delay differs by up to {1e3 * plant.delay_spread:g} ms from what the "
        f"controller knows, its lag by up to {percent(plant.lag_spread)}, and the encoder's zero "
        f"is wrong by up to {np.rad2deg(plant.zero_error):.2g}°"
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
        [row(results) for results in (evaluation.results, *evaluation.baselines)],
        caption="Intervals are exact (Clopper-Pearson).",
    )


def _deployment(results: Results, pictures: Pictures) -> Part:
    run = results.run
    world = run.conditions.world_settings
    return part(
        "deployment",
        "One run, as the paper shows it",
        paragraph(
            f"The paper shows {paper.SECONDS_BALANCED:g} s on the real arm in its figures 3 to 7. "
            f"Here {_stand_in(results)}"
        ),
        "" if world is None else _the_twin(TwinSettings.model_validate(world), results),
        table(("", "what the policy was trained for", "the run"), _conditions(results)),
        picture(
            pictures,
            "figure-3-frames",
            "The paper's figure 3, drawn from what the run went through, at moments that differ."
            " A pendulum that is kept upright hardly leans; it is the arm that moves.",
            "Frames of the run: arm, table, pendulum and the ends of the track",
        ),
        picture(
            pictures,
            "figure-4-commands",
            f"The paper's figure 4. There is no zero among the eight accelerations, so standing "
            f"still means switching to and fro{_what_the_flange_did(results)}.",
            "Commanded acceleration of the flange against time",
        ),
        picture(
            pictures,
            "figure-5-joints",
            f"The paper's figure 5, as commanded. {_which_joints(results)}",
            "Positions of the joints against time",
        ),
        picture(
            pictures,
            "figure-6-pendulum",
            "The paper's figure 6. Dotted lines are the edges of the boxes: between them the table "
            f"sees no difference.{_what_was_seen(results)}",
            "Angle and angular velocity of the pendulum against time",
        ),
        _zero(pictures) if estimates_zero(run) else "",
        picture(
            pictures,
            "figure-7-flange",
            f"The paper's figure 7. There, x passed {paper.X_AT_FAILURE:g} m after "
            f"{paper.SECONDS_BALANCED:g} s.",
            "Displacement and velocity of the flange against time",
        ),
    )


def _stand_in(results: Results) -> str:
    conditions = results.run.conditions
    if conditions.world == MODEL:
        return (
            "the simulated plant of the training stands in for the robot, with a pendulum that "
            f"differs from the one that the policy was trained for. {no_gap(results)}"
        )
    return (
        f"a digital twin of the rig stands in for it, `{conditions.world}`: the "
        f"{conditions.arm.name} in a physics engine that is not ours (MuJoCo), behind a model of "
        "the robot's own server and drives, with a pendulum that differs from the one that the "
        "policy was trained for. "
        "The policy has never been there."
    )


def _the_twin(twin: TwinSettings, results: Results) -> str:
    conditions = results.run.conditions
    dry = conditions.friction
    friction = (
        f"dry friction of {conditions.pendulum['coulomb']:.3g} 1/s^2 besides the viscous one"
        if dry is None
        else f"{PivotFriction.model_validate(dry).words(conditions.world)}, besides the viscous one"
    )
    has = (
        f"A transport delay: a setpoint is used {1e3 * twin.transport:g} ms after it was sent, "
        f"give or take {1e3 * twin.transport_jitter:g} ms.",
        "The servo law of the KUKA Sunrise Toolbox's server, from its source, every "
        f"{twin.cycle:g} ms: a soft dead band, which follows slow motions late.",
        f"Joint drives with a lag of {1e3 * twin.lag:g} ms and the torques of the real joints. "
        "They balance the arm's own weight and know its inertia at home; tool and pendulum "
        f"({1e3 * (twin.bracket_mass + twin.pendulum_mass):g} g) are unknown to them, and pull.",
        f"A pendulum that turns {1e3 * twin.pivot_outward:g} mm beside the last joint's axis, with "
        f"{friction}.",
        f"An encoder of {twin.counts_per_rev:,} counts a turn, read "
        f"{1e3 * twin.encoder_age:g} ms late, whose zero is wrong by up to "
        f"{np.rad2deg(twin.zero_error):.2g}°; and measured joints that are "
        f"{1e3 * twin.reply_age:g} ms old.",
    )
    has_not = (
        "elastic joints, friction and play in them, an arm and a table that bend, or an operating "
        "system that comes late; and what KUKA's cabinet really does with a setpoint is not "
        "published. Masses and torques are those of public models, other numbers are "
        "assumptions, each listed below with its source. It is a simulation, and not the authors' "
        "robot."
    )
    return paragraph("What it has:") + bullets(has) + paragraph(f"What it has not: {has_not}")


def _conditions(results: Results) -> Iterator[tuple[str, str, str]]:
    conditions, trained = results.run.conditions, results.pendulum.parameters()
    real = conditions.pendulum
    x, x_dot, phi, phi_dot = results.run.start
    yield "w2 [1/s²]", f"{trained.w2:.2f}", f"{real['w2']:.2f}"
    yield "k [1/m]", f"{trained.k:.3f}", f"{real['k']:.3f}"
    yield "c [1/s]", f"{trained.c:.4f}", f"{real['c']:.4f}"
    yield "dry friction / I [1/s²]", f"{trained.coulomb:g}", f"{real['coulomb']:g}"
    if conditions.zero_error is not None:
        zero = f"{np.rad2deg(conditions.zero_error):+.2f}°"
        yield "error of the encoder's zero", "unknown", zero
    yield (
        "start",
        "unknown",
        f"x = {x:g} m, dx/dt = {x_dot:g} m/s, φ = {np.rad2deg(phi):.2f}°, "
        f"dφ/dt = {np.rad2deg(phi_dot):.1f}°/s",
    )
    yield "end", "", f"{how_it_ended(results.run.cause)}, {results.run.lasted:g} s"


def _what_the_flange_did(results: Results) -> str:
    if not seen_otherwise(results.run):
        return ""
    return "; the close-up shows what the arm makes of it"


def _which_joints(results: Results) -> str:
    conditions = results.run.conditions
    first = "The joint that is held stays where it is; of the others, those"
    if conditions.arm.held_joint is None:
        first = "Those"
    text = f"{first} that turn about a vertical axis at home do most of the work."
    if seen_otherwise(results.run):
        text += (
            " At the bottom, by how much the arm is not where it was sent, at the same time: that "
            "grows with speed."
        )
    if conditions.world_settings is not None:
        text += " A part of it that stays is the weight that the drives do not know."
    return text


def _what_was_seen(results: Results) -> str:
    if not seen_otherwise(results.run):
        return ""
    policy, controller = results.policy, results.run.conditions.settings.controller
    if not controller.predict or policy.actuator.kind == "ideal":
        return " The dark line is what the policy saw, from the encoder; the pale one what was."
    ahead = horizon(policy.arm, policy.actuator, controller.margin)
    return (
        f" The dark line is what the policy saw: the state {1e3 * ahead:.0f} ms ahead, when its "
        "command has taken effect, as predicted from the encoder and the commands in flight. The "
        "pale line is what was. The dark one leads it by just that time, if the prediction is good."
    )


def _zero(pictures: Pictures) -> str:
    return picture(
        pictures,
        "encoder-zero",
        "The paper does not have this one. The encoder is zeroed where the pendulum hangs at rest, "
        "and friction lets it rest beside the vertical. A pendulum that leans falls faster and "
        "faster, one that only seems to lean does not: by that the controller tells the error "
        "while it balances, and takes it off.",
        "Error of the encoder's zero and its estimate against time",
    )


def _gap(results: Results, pictures: Pictures) -> Part:
    from equipoise.studies.gap_results import words

    name, title = "gap", "What the training did not know, and what that costs"
    gap = results.gap
    if gap is None:
        return part(name, title, paragraph(no_gap(results)))
    found = words(gap)
    return part(
        name,
        title,
        paragraph(
            "A policy that is trained without delay and with a perfect sensor meets both on the "
            "robot. On the twin they can be switched on and off one by one. Here is a short form "
            f"of that study, {gap.trials} trials of {gap.duration:g} s at each point; the full one "
            "is made by `equipoise gap`."
        ),
        conclusion(found[0]),
        bullets(found[1:]),
        picture(
            pictures,
            "gap",
            "Above, survival against the delay and against the error of the encoder's zero, with "
            "the share of the falls that end on the track limit below. At the bottom, for a table "
            "that was trained as the paper describes, each effect alone: switched on where nothing "
            "else is, and taken away where everything else is.",
            "Seconds of balance against delay and zero error, and effect by effect",
        ),
    )
