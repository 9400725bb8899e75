"""Appendix of the report: assumptions beyond the paper, provenance, commands to repeat it."""

from collections.abc import Iterator

import numpy as np

from equipoise.apps.report import markup as html
from equipoise.apps.report.choices import Chapter, Choice, chapter, chapters, departures
from equipoise.artefacts import Provenance
from equipoise.model.arms.arm import Arm
from equipoise.model.arms.resolve import DEFAULT, arm_option
from equipoise.model.worlds import TwinSettings
from equipoise.reproduction import results as files
from equipoise.reproduction.results import Results
from equipoise.settings import closest_recipe, resolve

DIGITS = 12
"""Number of hexadecimal digits of a digest on the page; the files hold all of them."""
CONTENTS = {
    files.SWING: "the free swing",
    files.PENDULUM: "the identified pendulum",
    files.POLICY: "the table, with its settings and learning curve",
    files.EVALUATION: "every trial of the policy and of the baselines",
    files.RUN: "the recorded run; Foxglove opens it",
    files.TWIN_EVALUATION: "every trial on the digital twin",
}


def assumptions(results: Results) -> html.Part:
    """Return our choices where the paper gives no value, with their reasons."""
    recipe, _ = closest_recipe(results.policy.settings)
    other = "robust" if recipe == "paper" else "paper"
    return html.part(
        "open",
        "Assumptions beyond the paper",
        html.paragraph(
            "The paper gives the boxes, the accelerations, the time step and the number of "
            "episodes, but not learning rate, discount, exploration, reward, noise amplitudes, "
            "gains, the pendulum's parameters, the posture, or the type of arm, nor the robot's "
            "sensor, servo and delay. These are our assumptions, read from their definitions; "
            "`--set name=value` changes those with a dot in their name. The recipe `robust` is our "
            "default, `paper` the most literal reading of the text; the other recipe's value has "
            "its own column where it differs."
        ),
        *(_choices(chapter, other) for chapter in _chapters(results, other)),
        html.heading("Deviations from the paper"),
        html.bullets(departures(results.policy.settings), "ol"),
    )


def _chapters(results: Results, other: str) -> Iterator[Chapter]:
    if results.record.simulated:
        yield chapter(results.record.simulated)
    yield _arm(results.policy.arm)
    yield from chapters(results.policy.settings, resolve(other))
    if world := results.run.conditions.world_settings:
        ran = chapter(TwinSettings.model_validate(world))
        yield ran._replace(title=f"World of the recorded run: `{results.run.conditions.world}`")


def _arm(arm: Arm) -> Chapter:
    home = ", ".join(f"{angle:.4g}" for angle in np.rad2deg(arm.home))
    held = f"joint {arm.held_joint}" if arm.held_joint else "none"
    pivot = ", ".join(f"{value:g}" for value in arm.pivot)
    posture = (
        "Far from joint limits and singularities, with x perpendicular to the direction of reach: "
        "the first joint does most of the motion."
    )
    choices = (
        Choice("arm", arm.name, "", "The paper does not name its seven-joint arm."),
        Choice("held joint", held, "", "As in the paper, for arms with seven joints."),
        Choice("home", f"{home}°", "", posture),
        Choice("pivot", f"{pivot} m", "", "Pivot of the pendulum in the flange frame."),
    )
    return Chapter("The arm and its posture.", choices)


def _choices(chapter: Chapter, other: str) -> str:
    rows = [["setting", "value", f"recipe `{other}`", "reason"]]
    rows += ([f"`{c.name}`", c.value, c.otherwise, c.reason] for c in chapter.choices)
    if not any(choice.otherwise for choice in chapter.choices):
        rows = [[name, value, reason] for name, value, _, reason in rows]
    head, *rows = rows
    return html.heading(chapter.title.rstrip(".")) + html.table(head, rows, name="choices")


def provenance_section(results: Results, provenance: Provenance) -> html.Part:
    """Return files, seeds, times and versions, and the commands that repeat the reproduction."""
    record, policy = results.record, results.policy
    rows = [(f"`{n}`", f"`{_short(digest)}`", CONTENTS[n]) for n, digest in record.files.items()]
    seeds = (
        f"Master seed {record.seed}, learner {policy.learner}, recipe `{policy.recipe}`, arm "
        f"{policy.arm.name}. Training, selection, test and the recorded run use separate random "
        "streams. On one machine an equal seed gives equal numbers, for any number of threads."
    )
    if not record.simulated:
        seeds += f" The swing is {record.swing} (SHA-256 {_short(record.swing_sha256)})."
    times = [(stage.name, f"{stage.wall:.2f}") for stage in record.stages]
    times.append(("all", f"{sum(stage.wall for stage in record.stages):.2f}"))
    software = [*sorted(provenance.software.items()), ("created", provenance.created)]
    return html.part(
        "origins",
        "Provenance and reproduction",
        html.paragraph(seeds),
        html.table(("file", "SHA-256", "content"), rows),
        html.table(
            ("stage", "time [s]"),
            times,
            caption=f"With {record.workers} threads; a first run also compiles the kernels.",
            numbers=1,
        ),
        html.table(("software", "version"), software),
        html.paragraph("Commands to repeat all of it, or one stage from the files in this folder:"),
        html.listing(_commands(results)),
    )


def _short(digest: str) -> str:
    return digest.partition(":")[2][:DIGITS]


def _commands(results: Results) -> list[str]:
    record, world = results.record, results.run.conditions.world
    recipe, _ = closest_recipe(results.policy.settings)
    arm = arm_option(results.policy.arm.name)
    options = {
        f"--swing {record.swing}": not record.simulated,
        f"--recipe {recipe}": recipe != "robust",
        f"--arm {arm}": arm is not None,
        f"--seed {record.seed}": bool(record.seed),
        "--quick": record.quick,
    }
    return [
        " ".join(["equipoise reproduce", *(text for text, given in options.items() if given)]),
        "",
        f"equipoise identify {files.SWING} --out {files.PENDULUM}",
        f"equipoise train {files.PENDULUM} --arm {arm or DEFAULT} --out {files.POLICY}",
        f"equipoise evaluate {files.POLICY} --world {world}",
        f"equipoise deploy {files.POLICY} --world {world}",
        f"equipoise log explain {files.RUN}",
    ]
