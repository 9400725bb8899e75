"""The end of the report: what the paper leaves open, where it all comes from, how to repeat it."""

from collections.abc import Iterator

import numpy as np

from equipoise.artefacts import Provenance
from equipoise.model.arms.arm import Arm
from equipoise.model.arms.resolve import DEFAULT, arm_word
from equipoise.model.sim_configs import TwinSettings
from equipoise.report.choices import Chapter, Choice, chapter, chapters, departures
from equipoise.report.markup import Part, heading, listing, numbered, paragraph, part, table
from equipoise.settings import closest_recipe, resolve
from equipoise.studies.results import (
    EVALUATION,
    GAP,
    PENDULUM,
    POLICY,
    RUN,
    SWING,
    Results,
)

DIGITS = 12
"""Digits of a digest that the page shows; the file has all of them."""


def assumptions(results: Results) -> Part:
    """Return what the paper does not say, and what we chose, with the reasons."""
    recipe, _ = closest_recipe(results.policy.settings)
    other = "robust" if recipe == "paper" else "paper"
    return part(
        "open",
        "What the paper leaves open",
        paragraph(
            "The paper gives the boxes, the accelerations, the time step and the number of "
            "episodes. It does not give learning rate, discount, exploration, reward, sizes of "
            "noise, gains, the pendulum's numbers, the posture, or which arm. These are our "
            "choices, read from where they are defined; those with a dot in their name can be "
            "changed with `--set name=value`. It says nothing about sensor, servo and delay of the "
            "robot either: of these, what is not a fact of its server is listed as our assumption. "
            "The recipe `robust` is our default, `paper` the "
            "barest reading of the text; where the one that was not used differs, it has a column "
            "of its own."
        ),
        *(_choices(chapter, other) for chapter in _chapters(results, other)),
        heading("Where we depart from the paper"),
        numbered(departures(results.policy.settings)),
    )


def _chapters(results: Results, other: str) -> Iterator[Chapter]:
    if results.record.simulated:
        yield chapter(results.record.simulated)
    yield _arm(results.policy.arm)
    yield from chapters(results.policy.settings, resolve(other))
    if world := results.run.conditions.world_settings:
        ran = chapter(TwinSettings.model_validate(world))
        yield ran._replace(title=f"The world that ran: `{results.run.conditions.world}`")


def _arm(arm: Arm) -> Chapter:
    home = ", ".join(f"{angle:.4g}" for angle in np.rad2deg(arm.home))
    held = f"joint {arm.held_joint}" if arm.held_joint else "none"
    reach = ", ".join(f"{value:g}" for value in arm.pivot)
    return Chapter(
        "The arm and its posture.",
        (
            Choice("arm", arm.name, "", "The paper does not say which arm of seven joints."),
            Choice("held joint", held, "", "The paper's, where the arm has seven joints."),
            Choice(
                "home",
                f"{home}°",
                "",
                "Far from every joint limit and from singular postures, with x across the "
                "direction in which the arm reaches out: the first joint does most of the motion.",
            ),
            Choice("pivot", f"{reach} m", "", "Where the pendulum turns, in the flange frame."),
        ),
    )


def _choices(chapter: Chapter, other: str) -> str:
    differs = any(choice.otherwise for choice in chapter.choices)
    head = ["setting", "here", *([f"recipe `{other}`"] if differs else []), "why"]
    rows = [
        [f"`{c.name}`", c.value, *([c.otherwise] if differs else []), c.reason]
        for c in chapter.choices
    ]
    return heading(chapter.title.rstrip(".")) + table(head, rows, name="choices")


def provenance_section(results: Results, provenance: Provenance) -> Part:
    """Return where the numbers come from, and the commands that make them again."""
    record, policy = results.record, results.policy
    files = [
        (f"`{name}`", f"`{digest.partition(':')[2][:DIGITS]}`", _content(name))
        for name, digest in record.files.items()
    ]
    seeds = (
        f"Master seed {record.seed}, learner {policy.learner}, recipe `{policy.recipe}`, arm "
        f"{policy.arm.name}; training, selection, test and the recorded run draw from streams of "
        "their own. Equal seed gives equal numbers on one machine, whatever the number of threads."
    )
    if not record.simulated:
        digest = record.swing_sha256.partition(":")[2][:DIGITS]
        seeds += f" The swing is {record.swing} (SHA-256 {digest})."
    total = sum(stage.wall for stage in record.stages)
    return part(
        "origins",
        "Where it comes from, and how to repeat it",
        paragraph(seeds),
        table(("file", "SHA-256", "holds"), files),
        table(
            ("stage", "time [s]"),
            [
                *((stage.name, f"{stage.wall:.2f}") for stage in record.stages),
                ("all", f"{total:.2f}"),
            ],
            caption=f"With {record.workers} threads; a first run also compiles the kernels.",
            numbers=1,
        ),
        table(
            ("software", "version"),
            [*sorted(provenance.software.items()), ("made", provenance.created)],
        ),
        paragraph("All of it again, or stage by stage from the files in this folder:"),
        listing(_commands(results)),
    )


def _content(name: str) -> str:
    return {
        SWING: "the free swing",
        PENDULUM: "what it identified",
        POLICY: "the table, with its settings and learning curve",
        EVALUATION: "every trial of the policy and of the yardsticks",
        RUN: "the recorded run; Foxglove opens it",
        GAP: "every trial of the study of the gap",
    }[name]


def _commands(results: Results) -> list[str]:
    record = results.record
    everything = ["equipoise reproduce"]
    if not record.simulated:
        everything.append(f"--swing {record.swing}")
    recipe, _ = closest_recipe(results.policy.settings)
    if recipe != "robust":
        everything.append(f"--recipe {recipe}")
    arm = arm_word(results.policy.arm.name)
    if arm is not None:
        everything.append(f"--arm {arm}")
    if record.seed:
        everything.append(f"--seed {record.seed}")
    if record.quick:
        everything.append("--quick")
    world = results.run.conditions.world
    return [
        " ".join(everything),
        "",
        f"equipoise identify {SWING} --out {PENDULUM}",
        f"equipoise train {PENDULUM} --arm {arm or DEFAULT} --out {POLICY}",
        f"equipoise evaluate {POLICY} --world {world}",
        f"equipoise deploy {POLICY} --world {world}",
        *([f"equipoise gap {POLICY} --world {world}"] if results.gap else []),
        f"equipoise log show {RUN}",
    ]
