"""Sections of the report on the policy: the table, its trials, the recorded run, the gap."""

from collections.abc import Iterator

import numpy as np

from equipoise import paper
from equipoise.control.control_step import horizon
from equipoise.evaluation import Evaluation
from equipoise.model.sim_configs import MODEL, PivotFriction, TwinSettings
from equipoise.report import markup as html
from equipoise.studies.formatting import falls, how_it_ended, percent
from equipoise.studies.gap_results import words
from equipoise.studies.results import Results, estimates_zero, no_gap, seen_otherwise


def sections_results(results: Results, pictures: html.Pictures) -> Iterator[html.Part]:
    """Return the sections from the trained policy on."""
    yield _policy(pictures)
    yield _evaluation(results, pictures)
    yield _deployment(results, pictures)
    yield _gap(results, pictures)


def _policy(pictures: html.Pictures) -> html.Part:
    return html.part(
        "policy",
        "The learned policy",
        html.paragraph(
            "The policy is one acceleration for each box. Each panel shows the lean of the "
            "pendulum from left to right, and its angular velocity from bottom to top. In the "
            "upper right corner the pendulum leans right and falls right, and the flange must "
            "accelerate to the right to get below it: red. The lower left corner is the mirror "
            "image."
        ),
        html.paragraph(
            "The columns are positions on the track. The return from the right end starts with a "
            "motion further to the right, until the pendulum leans left; then the flange follows "
            "it to the middle. So near upright the right column pushes right and the left column "
            "pushes left. A good policy stays in the middle row; the outer rows are rarely visited "
            "and their entries are rough."
        ),
        html.picture(
            pictures,
            "policy",
            "The 270 boxes: blue accelerates left, red right. Hatched boxes were never visited in "
            "training, and their entries have no meaning. Framed boxes were visited by the "
            "recorded run below.",
            "Commanded acceleration in each of the 270 boxes, as a grid of coloured numbers",
        ),
    )


def _evaluation(results: Results, pictures: html.Pictures) -> html.Part:
    evaluation = results.evaluation
    e, plant = evaluation.settings.evaluation, evaluation.settings.plant
    phi, phi_dot = (
        f"{np.rad2deg(low):.3g}° to {np.rad2deg(high):.3g}°"
        for low, high in ((e.phi_low, e.phi_high), (e.phi_dot_low, e.phi_dot_high))
    )
    arm = (
        f"; the arm's delay differs by up to {1e3 * plant.delay_spread:g} ms from the controller's "
        f"value, its lag by up to {percent(plant.lag_spread)}, and the encoder's zero is wrong by "
        f"up to {np.rad2deg(plant.zero_error):.2g}°"
    )
    return html.part(
        "evaluation",
        "Survival on the training plant",
        html.paragraph(
            "The training plant is fast to simulate, so it comes first. Each trial starts as after "
            "a release by hand: the flange at rest in the middle, the pendulum leaning "
            f"{phi} and falling outwards at {phi_dot} per second. I varies by "
            f"{percent(plant.inertia_sigma)} around the value of the training and b by "
            f"{percent(plant.friction_sigma)} (standard deviations), with noise in every step"
            f"{'' if plant.ideal else arm}. No other stage uses these starts and seeds."
        ),
        html.picture(
            pictures,
            "survival",
            "The time axis on the left is logarithmic. LQR knows the model and commands any "
            "acceleration within the range; snapped LQR uses the nearest of the table's eight. PD "
            "keeps the pendulum upright but ignores the ends of the track. Random picks any of the "
            "eight.",
            "Share of the trials still standing against time, for the policy and the baselines",
        ),
        _survival_table(evaluation),
    )


def _survival_table(evaluation: Evaluation) -> str:
    rows: list[list[str]] = []
    for results in (evaluation.results, *evaluation.baselines):
        s = results.summary()
        low, high = s.interval
        rows.append(
            [
                results.name,
                f"{s.survived} of {s.trials}",
                f"{percent(low)} to {percent(high)}",
                f"{s.median:.3g} s",
                f"{s.quantiles[0]:.3g} s",
                falls(s.causes),
            ]
        )
    stood = f"stood {evaluation.duration:g} s"
    return html.table(
        ("", stood, "95 % interval", "median", "5 % quantile", "failures"),
        rows,
        caption="Intervals are exact (Clopper-Pearson).",
    )


def _deployment(results: Results, pictures: html.Pictures) -> html.Part:
    run = results.run
    real = seen_otherwise(run)
    world = run.conditions.world_settings
    return html.part(
        "deployment",
        "Recorded run",
        html.paragraph(
            f"The paper shows {paper.SECONDS_BALANCED:g} s on the real arm in its figures 3 to 7. "
            f"{_stand_in(results)}"
        ),
        "" if world is None else _twin(TwinSettings.model_validate(world), results),
        html.table(("", "training", "the run"), _conditions(results)),
        html.picture(
            pictures,
            "figure-3-frames",
            "The paper's figure 3, drawn from the recorded motion at moments that differ most. A "
            "balanced pendulum hardly leans; the arm moves.",
            "Frames of the run: arm, table, pendulum and the ends of the track",
        ),
        html.picture(
            pictures,
            "figure-4-commands",
            "The paper's figure 4. The eight accelerations do not include zero, so the policy "
            "holds a position by switching between both signs"
            f"{'; the close-up shows the response of the flange' if real else ''}.",
            "Commanded acceleration of the flange against time",
        ),
        html.picture(
            pictures,
            "figure-5-joints",
            f"The paper's figure 5, as commanded. {_joints(results)}",
            "Positions of the joints against time",
        ),
        html.picture(
            pictures,
            "figure-6-pendulum",
            "The paper's figure 6. Dotted lines are the edges of the boxes; the table does not "
            f"distinguish values between them.{_observation(results)}",
            "Angle and angular velocity of the pendulum against time",
        ),
        _zero(pictures) if estimates_zero(run) else "",
        html.picture(
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
            "Here the simulated training plant replaces the robot, with a pendulum that differs "
            f"from that of the training. {no_gap(results)}"
        )
    return (
        f"Here a digital twin replaces the robot, `{conditions.world}`: the "
        f"{conditions.arm.name} in an independent physics engine (MuJoCo), with a model of the "
        "robot's server and drives, and a pendulum that differs from that of the training. The "
        "policy was not trained on the twin."
    )


def _twin(twin: TwinSettings, results: Results) -> str:
    conditions = results.run.conditions
    dry = conditions.friction
    friction = (
        f"dry friction of {conditions.pendulum['coulomb']:.3g} 1/s^2 besides the viscous one"
        if dry is None
        else f"{PivotFriction.model_validate(dry).words(conditions.world)}, besides the viscous one"
    )
    modelled = (
        f"A transport delay: a setpoint takes effect {1e3 * twin.transport:g} ms after it was "
        f"sent, ± {1e3 * twin.transport_jitter:g} ms.",
        "The servo law of the KUKA Sunrise Toolbox's server, from its source, every "
        f"{twin.cycle:g} ms: a soft dead band, which delays slow motions.",
        f"Joint drives with a lag of {1e3 * twin.lag:g} ms and the torques of the real joints. "
        "They compensate the arm's own weight and its inertia at home, but not the load of tool "
        f"and pendulum ({1e3 * (twin.bracket_mass + twin.pendulum_mass):g} g).",
        f"A pendulum whose pivot is {1e3 * twin.pivot_outward:g} mm beside the last joint's axis, "
        f"with {friction}.",
        f"An encoder with {twin.counts_per_rev:,} counts per turn, read "
        f"{1e3 * twin.encoder_age:g} ms late, whose zero is wrong by up to "
        f"{np.rad2deg(twin.zero_error):.2g}°; and joint measurements with an age of "
        f"{1e3 * twin.reply_age:g} ms.",
    )
    missing = (
        "elasticity, friction and backlash of the joints, a flexible arm or table, and delays of "
        "the operating system. KUKA has not published how its cabinet processes a setpoint. Masses "
        "and torques are those of public models; other numbers are assumptions, each listed below "
        "with its source. This is a simulation, and not the authors' robot."
    )
    return (
        html.paragraph("The twin models:")
        + html.bullets(modelled)
        + html.paragraph(f"The twin does not model: {missing}")
    )


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


def _joints(results: Results) -> str:
    conditions = results.run.conditions
    held = "" if conditions.arm.held_joint is None else " One joint is held."
    text = f"The joints with a vertical axis at home do most of the work.{held}"
    if seen_otherwise(results.run):
        text += " Bottom: the lag of the arm behind its commands, which grows with speed."
    if conditions.world_settings is not None:
        text += " Its constant part is the load that the drives do not compensate."
    return text


def _observation(results: Results) -> str:
    if not seen_otherwise(results.run):
        return ""
    policy, controller = results.policy, results.run.conditions.settings.controller
    if not controller.predict or policy.actuator.kind == "ideal":
        return (
            " The dark line is the policy's observation, from the encoder; the pale line is true."
        )
    ahead = horizon(policy.arm, policy.actuator, controller.margin)
    return (
        f" The dark line is the policy's observation: the state {1e3 * ahead:.0f} ms ahead, when "
        "its command takes effect, predicted from the encoder and the commands in flight. The pale "
        "line is the true state. With a good prediction the dark line leads by exactly that time."
    )


def _zero(pictures: html.Pictures) -> str:
    return html.picture(
        pictures,
        "encoder-zero",
        "Not in the paper. The encoder is zeroed with the pendulum hanging at rest, and friction "
        "holds it slightly off the vertical. A true lean accelerates the fall; an error of the "
        "zero does not. From this difference the controller estimates the error while balancing "
        "and subtracts it.",
        "Error of the encoder's zero and its estimate against time",
    )


def _gap(results: Results, pictures: html.Pictures) -> html.Part:
    name, title = "gap", "Gap between training plant and twin"
    gap = results.gap
    if gap is None:
        return html.part(name, title, html.paragraph(no_gap(results)))
    conclusion, *findings = words(gap)
    return html.part(
        name,
        title,
        html.paragraph(
            "A policy that is trained without delay and with a perfect sensor meets both on the "
            "robot. On the twin each effect can be switched on and off. This is the short form "
            f"of that study, {gap.trials} trials of {gap.duration:g} s at each point; "
            "`equipoise gap` runs the full study."
        ),
        html.paragraph(conclusion, "conclusion"),
        html.bullets(findings),
        html.picture(
            pictures,
            "gap",
            "Top: survival against the delay and against the error of the encoder's zero, with "
            "the share of the falls that end on the track limit below. Bottom: each effect alone, "
            "for a table that was trained as the paper describes: switched on in the clean twin, "
            "and removed from the full twin.",
            "Seconds of balance against delay and zero error, and effect by effect",
        ),
    )
