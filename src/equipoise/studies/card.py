"""Policy card: what a policy is, how it was trained, where it stands, and what it is not for.

The card is Markdown with the YAML header of a Hugging Face model card, so that a repository there
shows it. All figures are those of the policy's file, and of evaluations and certificates of this
policy; the card measures nothing.
"""

import json
import re
from collections.abc import Iterable, Sequence
from math import degrees
from pathlib import Path
from typing import Any, Final

from equipoise.artefacts import Provenance, read_document
from equipoise.control.policy import TabularPolicy, format_share
from equipoise.errors import InputError
from equipoise.evaluation import Evaluation
from equipoise.paper import PHI_LIMIT_DEG, X_LIMIT
from equipoise.printable import printable
from equipoise.studies.certification import Certificate, check_evaluation, evaluation_path
from equipoise.studies.formatting import format_failures, percent

MARKUP: Final = re.compile(r"([\\`*_\[\]|~$])")
"""Characters with a meaning inside a line of Markdown."""
TASK: Final = {"type": "reinforcement-learning", "name": "balance an inverted pendulum on an arm"}
"""Task of the results in the header."""
TAGS: Final = (
    "reinforcement-learning",
    "robotics",
    "q-learning",
    "inverted-pendulum",
    "sim-to-real",
)
"""Tags of the card."""

Evidence = Evaluation | Certificate


def literal(text: str) -> str:
    """Return a text that Markdown shows as it is, on one line."""
    escaped = printable(text).replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    return MARKUP.sub(r"\\\1", escaped)


def read_evidence(path: Path, policy: TabularPolicy) -> Evidence:
    """Read an evaluation or a certificate of a policy.

    Args:
        path: The file.
        policy: The policy.

    Raises:
        ArtefactError: The file is damaged, or a certificate does not match the trials beside it.
        InputError: The file is of another kind, or of another policy.
    """
    kind = read_document(path)["format"]
    if kind == Certificate.FORMAT:
        found: Evidence = Certificate.load(path)
        if (trials := evaluation_path(path)).exists():
            check_evaluation(found, trials)
    elif kind == Evaluation.FORMAT:
        found = Evaluation.load(path)
    else:
        raise InputError(
            f"{path} holds {kind!r}, expected an evaluation or a certificate; make one with "
            "equipoise evaluate"
        )
    if found.policy != policy.digest:
        raise InputError(
            f"{path} is of another policy ({found.policy[:19]}...), expected {policy.digest[:19]}"
            "...; evaluate this policy"
        )
    return found


def card(
    policy: TabularPolicy,
    origin: Provenance | None,
    evidence: Sequence[Evidence] = (),
    *,
    name: str,
    file: str = "policy.json",
) -> str:
    """Return the card of a policy.

    Args:
        policy: The policy.
        origin: Origin of its file, if known.
        evidence: Evaluations and certificates of this policy; see `read_evidence`.
        name: Name of the policy on the card.
        file: Name of its file.

    Returns:
        Markdown with a YAML header, ending in a line break.
    """
    parts = (
        _header(evidence, name),
        f"# {literal(name)}",
        _summary(policy),
        "## What it is",
        _table(_contents(policy)),
        "## How it was trained",
        _table(_training(policy, origin)),
        "## Where it stands",
        _standing(policy, evidence),
        "## What it is not for",
        "\n".join(f"- {line}" for line in _limits(policy, evidence)),
        "## Use",
        _use(policy, file),
        "## Reference",
        "Safeea & Neto, *A Q-learning approach to the continuous control problem of robot inverted "
        "pendulum balancing*, Intelligent Systems with Applications, whose system Equipoise "
        "implements.",
    )
    return "\n\n".join(parts) + "\n"


def _header(evidence: Sequence[Evidence], name: str) -> str:
    """Return the YAML header; each value is JSON, which is YAML."""
    results = [_result(each) for each in evidence]
    fields: dict[str, Any] = {
        "library_name": "equipoise",
        "pipeline_tag": "reinforcement-learning",
        "tags": TAGS,
    }
    lines = [f"{key}: {json.dumps(value)}" for key, value in fields.items()]
    if results:
        lines += ["model-index:", f"- name: {json.dumps(name)}", "  results:"]
        lines += [f"  - {json.dumps(result)}" for result in results]
    return "\n".join(("---", *lines, "---"))


def _result(found: Evidence) -> dict[str, Any]:
    """Return an entry of the model index."""
    if isinstance(found, Certificate):
        claim = found.claim
        world = claim.world
        metric = {
            "type": "lower-bound-of-survival",
            "value": found.bound,
            "name": f"claim {'granted' if found.granted else 'refused'}: {claim.text}",
        }
    else:
        summary = found.results.summary()
        low, high = summary.interval
        world = found.world
        metric = {
            "type": "survival",
            "value": summary.rate,
            "name": f"share of {summary.trials} trials of {found.duration:g} s that lasted, "
            f"95 % interval {low:.4f} to {high:.4f}",
        }
    dataset = {"type": "simulation", "name": world}
    return {"task": TASK, "dataset": dataset, "metrics": [metric]}


def _table(rows: Iterable[tuple[str, str]]) -> str:
    lines = (f"| {name} | {literal(text)} |" for name, text in rows)
    return "\n".join(("| | |", "| --- | --- |", *lines))


def _summary(policy: TabularPolicy) -> str:
    return (
        f"A table of {len(policy.Q)} boxes and {len(policy.actions)} accelerations that balances "
        f"an inverted pendulum on the flange of a robot arm ({literal(policy.arm.name)}), learned "
        "in simulation with Equipoise."
    )


def _contents(policy: TabularPolicy) -> Iterable[tuple[str, str]]:
    w2, c, arm = policy.pendulum.w2, policy.pendulum.c, policy.arm
    yield (
        "input",
        "x [m], x_dot [m/s], phi [rad], phi_dot [rad/s] when u takes effect",
    )
    yield "output", f"acceleration of the flange along x, up to {policy.u_max:g} m/s^2"
    yield "time step", f"{policy.h:g} s"
    yield "arm", f"{arm.name}, home at {_angles(arm.home_free)} deg of the free joints"
    yield "pendulum", f"w2 = {w2.value:.4g} 1/s^2, c = {c.value:.3g} 1/s"
    for each in policy.actuators:
        lags = ", ".join(f"{1e3 * lag.value:.1f}" for lag in each.lags)
        yield (
            "actuator",
            f"servo law {each.kind}, transport delay {1e3 * each.delay.value:.1f} ms, "
            f"lags {lags} ms",
        )
    yield "digest", policy.digest


def _angles(joints: Iterable[float]) -> str:
    return ", ".join(f"{degrees(angle):.1f}" for angle in joints)


def _training(policy: TabularPolicy, origin: Provenance | None) -> Iterable[tuple[str, str]]:
    learning = policy.settings.learning
    yield "recipe", policy.recipe
    yield "learner", f"{learning.learner}, reward {learning.reward}"
    yield "length", f"{policy.episodes:,} episodes, {policy.steps:,} steps"
    yield "seed", f"{policy.seed}, learner {policy.learner}"
    yield "candidates", f"{len(policy.checkpoints)}" if policy.checkpoints else "the last table"
    if origin is not None:
        yield "made", f"{origin.created} by {origin.command}"
        yield "software", ", ".join(f"{name} {text}" for name, text in origin.software.items())


def _standing(policy: TabularPolicy, evidence: Sequence[Evidence]) -> str:
    """Return the table of the trials, all of them in simulation."""
    rows = [
        ("test of its training", "model", f"{test.text}; {format_failures(test.causes)}")
        for test in policy.tests
    ]
    for found in evidence:
        if isinstance(found, Certificate):
            verdict, claim = "granted" if found.granted else "**refused**", found.claim
            failures, bound = format_failures(found.failures), format_share(found.bound)
            text = f"{claim.text}; {claim.trials:,} trials, {failures}, lower bound {bound}"
            rows.append((f"claim {verdict}", claim.world, text))
            continue
        summary = found.results.summary()
        low, high = summary.interval
        text = (
            f"{summary.survived:,} of {summary.trials:,} trials lasted {found.duration:g} s "
            f"(95 %: {percent(low)} to {percent(high)}); {format_failures(summary.causes)}"
        )
        rows.append(("evaluation", found.world, text))
    if not rows:
        return "Nobody has tested it: its file holds no test, and no evaluation was given."
    lines = (f"| {what} | {literal(world)} | {literal(text)} |" for what, world, text in rows)
    return "\n".join(("| | world | trials |", "| --- | --- | --- |", *lines))


def _limits(policy: TabularPolicy, evidence: Sequence[Evidence]) -> Iterable[str]:
    e = policy.settings.evaluation
    yield (
        "A robot, by these figures alone: they are from simulations. Read the safety case of "
        "Equipoise, and try it under an operator."
    )
    yield (
        f"Other pendulums or arms: identify yours, and train for it. This one has a period of "
        f"{policy.pendulum.period:.2f} s when it hangs."
    )
    yield (
        f"Swinging up: it begins within {degrees(e.phi_low):g} to {degrees(e.phi_high):g} deg of "
        f"upright, as after a release by hand, and gives up beyond {PHI_LIMIT_DEG:g} deg or at the "
        f"end of the track, {X_LIMIT:g} m from the middle."
    )
    if policy.shortfall:
        yield f"Its training target: {literal(policy.shortfall)}."
    if any(isinstance(found, Certificate) and not found.granted for found in evidence):
        yield "The claims that are refused above."


def _use(policy: TabularPolicy, file: str) -> str:
    shown = printable(file).replace("`", "'")
    words = f"'{shown}'" if re.search(r"[^\w./-]", shown) else shown
    return (
        "With Equipoise installed:\n\n```sh\n"
        f"equipoise log verify {words}\n"
        f"equipoise evaluate {words} --world twin:nominal\n"
        f"equipoise deploy {words} --robot twin:nominal\n"
        "```"
    )
