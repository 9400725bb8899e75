"""Sections of the report on the policy: the table, its trials, the recorded run."""

from collections.abc import Iterator

import numpy as np

from equipoise import paper
from equipoise.apps.report import markup as html
from equipoise.control.control_step import horizon
from equipoise.model.worlds import MODEL, PivotFriction, TwinSettings
from equipoise.reproduction.results import Results, estimates_zero, observation_differs
from equipoise.worlds.formatting import format_end, format_failures, percent


def sections_results(results: Results, picture: html.Picture) -> Iterator[html.Part]:
    """Yield the sections on the policy, its evaluation and the recorded run."""
    yield _policy(picture)
    yield _evaluation(results, picture)
    yield _deployment(results, picture)


def _policy(picture: html.Picture) -> html.Part:
    return html.part(
        "policy",
        "The learned policy",
        html.paragraph(
            "The policy is one acceleration per box. In each panel the lean of the pendulum grows "
            "from left to right, its angular velocity from bottom to top. In the upper right "
            "corner the pendulum leans and falls right, and the flange must accelerate right to "
            "get below it: red. The lower left corner is the mirror image."
        ),
        html.paragraph(
            "The columns are positions on the track, where the flange is going at its present "
            "drift if the policy looks ahead. To return from the right end, the flange "
            "first moves further right until the pendulum leans left, then follows it to the "
            "middle. So near upright the right column pushes right and the left column left. A "
            "good policy stays in the middle row; entries of the rarely visited outer rows are "
            "rough."
        ),
        picture(
            "policy",
            "Blue boxes accelerate left, red ones right. Hatched boxes were never visited in "
            "training: their entries have no meaning. The recorded run visited the framed boxes.",
            "Commanded acceleration in each of the boxes, as a grid of coloured numbers",
        ),
    )


def _evaluation(results: Results, picture: html.Picture) -> html.Part:
    evaluation = results.evaluation
    e, plant = evaluation.settings.evaluation, evaluation.settings.plant
    phi, phi_dot = (
        f"{np.rad2deg(low):.3g}° to {np.rad2deg(high):.3g}°"
        for low, high in ((e.phi_low, e.phi_high), (e.phi_dot_low, e.phi_dot_high))
    )
    arm = (
        f"; the arm's delay is off by up to {1e3 * plant.delay_spread:g} ms, its lag by up to "
        f"{percent(plant.lag_spread)}, the encoder's zero by up to "
        f"{np.rad2deg(plant.zero_error):.2g}°"
    )
    rows: list[list[str]] = []
    for trials in (evaluation.results, *evaluation.baselines):
        s = trials.summary()
        interval = " to ".join(map(percent, s.interval))
        times = f"{s.median:.3g} s", f"{s.quantiles[0]:.3g} s"
        failures = format_failures(s.causes)
        rows.append([trials.name, f"{s.survived} of {s.trials}", interval, *times, failures])
    stood = f"stood {evaluation.duration:g} s"
    return html.part(
        "evaluation",
        "Survival on the training plant",
        html.paragraph(
            "Each trial starts as after a release by hand: the flange at rest in the middle, the "
            f"pendulum leaning {phi} and falling outwards at {phi_dot} per second. I and b vary by "
            f"{percent(plant.inertia_sigma)} and {percent(plant.friction_sigma)} around the values "
            "of the training (standard deviations), with noise in every step"
            f"{'' if plant.ideal else arm}. No other stage uses these starts and seeds."
        ),
        picture(
            "survival",
            "The time axis is logarithmic. LQR knows the model and commands any acceleration "
            "within the range; snapped LQR uses the nearest of the table's eight. PD keeps the "
            "pendulum upright but ignores the ends of the track. Random picks any of the eight.",
            "Share of the trials still standing against time, for the policy and the baselines",
        ),
        html.table(
            ("", stood, "95 % interval", "median", "5 % quantile", "failures"),
            rows,
            caption="Intervals are exact (Clopper-Pearson).",
        ),
    )


def _deployment(results: Results, picture: html.Picture) -> html.Part:
    run = results.run
    real = observation_differs(run)
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
        picture(
            "figure-3-frames",
            "The paper's figure 3, drawn from the recorded motion at its extreme moments. A "
            "balanced pendulum hardly leans; the arm moves.",
            "Frames of the run: arm, table, pendulum and the ends of the track",
        ),
        picture(
            "figure-4-commands",
            "The paper's figure 4. No acceleration is zero, so the policy holds a position by "
            "switching between both signs"
            f"{'; the close-up shows the response of the flange' if real else ''}.",
            "Commanded acceleration of the flange against time",
        ),
        picture(
            "figure-5-joints",
            f"The paper's figure 5, as commanded. {_joints(results)}",
            "Positions of the joints against time",
        ),
        picture(
            "figure-6-pendulum",
            f"The paper's figure 6. Dotted lines: edges of the boxes.{_observation(results)}",
            "Angle and angular velocity of the pendulum against time",
        ),
        _zero(picture) if estimates_zero(run) else "",
        picture(
            "figure-7-flange",
            f"The paper's figure 7. There, x passed {paper.X_AT_FAILURE:g} m after "
            f"{paper.SECONDS_BALANCED:g} s.",
            "Displacement and velocity of the flange against time",
        ),
    )


def _stand_in(results: Results) -> str:
    conditions, pendulum = results.run.conditions, "a pendulum that differs from the training's"
    if conditions.world == MODEL:
        where = "the simulated training plant replaces the robot"
        unknown = f"There is no twin of the {conditions.arm.name}, whose masses are not known."
        return f"Here {where}, with {pendulum}. {unknown}"
    return (
        f"Here a digital twin replaces the robot, `{conditions.world}`: the "
        f"{conditions.arm.name} in an independent physics engine (MuJoCo), a model of its server "
        f"and drives, and {pendulum}. The policy was not trained on the twin."
    )


def _twin(twin: TwinSettings, results: Results) -> str:
    conditions = results.run.conditions
    dry = conditions.friction
    if dry is None:
        friction = f"dry friction of {conditions.pendulum['coulomb']:.3g} 1/s^2"
    else:
        friction = f"{PivotFriction.model_validate(dry).describe(conditions.world)},"
    modelled = (
        f"A transport delay: a setpoint takes effect {1e3 * twin.transport:g} ms after it was "
        f"sent, ± {1e3 * twin.transport_jitter:g} ms.",
        *_servo(twin),
        "Joints with rotors, and the torques of the real ones. Their drives compensate the arm's "
        "weight and its inertia at home, but not the load of tool and pendulum "
        f"({1e3 * (twin.bracket_mass + twin.pendulum_mass):g} g).",
        f"A pendulum whose pivot is {1e3 * twin.pivot_outward:g} mm beside the last joint's axis, "
        f"with {friction} besides the viscous one.",
        f"An encoder with {twin.counts_per_rev:,} counts per turn, read "
        f"{1e3 * twin.encoder_age:g} ms late, whose zero is wrong by up to "
        f"{np.rad2deg(twin.zero_error):.2g}°; joint measurements {1e3 * twin.reply_age:g} ms old.",
    )
    return (
        html.paragraph("The twin models:")
        + html.bullets(modelled)
        + html.paragraph(
            "The twin does not model: elasticity, friction and backlash of the joints, a flexible "
            "arm or table, and delays of the operating system. KUKA has not published how its "
            "cabinet processes a setpoint. Masses and torques are those of public models; other "
            "numbers are assumptions, listed below. It is a simulation, not the authors' robot."
        )
    )


def _servo(twin: TwinSettings) -> Iterator[str]:
    if twin.shaped:
        yield (
            "The servo law of the KUKA Sunrise Toolbox's server, from its source, every "
            f"{twin.cycle:g} ms: a soft dead band, which delays slow motions."
        )
    else:
        yield "A servo without a shaping law: the drives follow each setpoint itself."
    if twin.inner == "pd":
        frequency = f"{twin.pd_frequency:g} rad/s"
        yield f"Joint drives that control the position, critically damped at {frequency}."
    else:
        slowly = " They take 40 ms to each destination." * (twin.inner == "trajectory40")
        yield f"Joint drives with a lag of {1e3 * twin.lag:g} ms.{slowly}"


def _conditions(results: Results) -> Iterator[tuple[str, str, str]]:
    conditions, trained = results.run.conditions, results.pendulum.parameters()
    real, (x, x_dot, *angles) = conditions.pendulum, conditions.start or (0.0,) * 4
    phi, phi_dot = np.rad2deg(angles)
    yield "w2 [1/s²]", f"{trained.w2:.2f}", f"{real['w2']:.2f}"
    yield "k [1/m]", f"{trained.k:.3f}", f"{real['k']:.3f}"
    yield "c [1/s]", f"{trained.c:.4f}", f"{real['c']:.4f}"
    yield "dry friction / I [1/s²]", f"{trained.coulomb:g}", f"{real['coulomb']:g}"
    if (zero := conditions.zero_error) is not None:
        yield "error of the encoder's zero", "unknown", f"{np.rad2deg(zero):+.2f}°"
    track = f"x = {x:g} m, dx/dt = {x_dot:g} m/s"
    yield "start", "unknown", f"{track}, φ = {phi:.2f}°, dφ/dt = {phi_dot:.1f}°/s"
    yield "end", "", f"{format_end(results.run.cause)}, {results.run.lasted:g} s"


def _joints(results: Results) -> str:
    conditions = results.run.conditions
    text = "The joints with a vertical axis at home do most of the work."
    if conditions.arm.held_joint is not None:
        text += " One joint is held."
    if observation_differs(results.run):
        text += " Bottom: the lag of the arm behind its commands, which grows with speed."
    if conditions.world_settings is not None:
        text += " Its constant part is the load that the drives do not compensate."
    return text


def _observation(results: Results) -> str:
    if not observation_differs(results.run):
        return ""
    policy, controller = results.policy, results.run.conditions.settings.controller
    lines = " The pale line is the true state, the dark line the policy's observation"
    if not controller.predict or policy.actuator.kind == "ideal":
        return f"{lines}, from the encoder."
    ahead = horizon(policy.arm, policy.actuator, controller.margin, lead=controller.lead)
    return (
        f"{lines}: the state {1e3 * ahead:.0f} ms ahead, when its command takes effect, predicted "
        "from the encoder and the commands in flight. A good prediction leads by exactly that time."
    )


def _zero(picture: html.Picture) -> str:
    return picture(
        "encoder-zero",
        "Not in the paper. When the encoder is zeroed, friction holds the hanging pendulum off the "
        "vertical. A true lean accelerates the fall, an error of the zero does not: from this "
        "difference the controller estimates the error while balancing, and subtracts it.",
        "Error of the encoder's zero and its estimate against time",
    )
