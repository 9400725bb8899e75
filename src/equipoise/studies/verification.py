"""Verify: what is this file, and is it what was written?

Any file of ours says its format, version, digest and history. It is read in full, by the rules of
its own kind, so that a file that passes here can be used.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from equipoise.artefacts import Artefact, Provenance, read_document
from equipoise.control.policy import TabularPolicy
from equipoise.errors import ArtefactError
from equipoise.evaluation import Evaluation
from equipoise.model.pendulum import Pendulum


class Verified(NamedTuple):
    """A file of ours that is what was written."""

    what: str
    """In a word or two."""
    format: str
    """Name of its format."""
    version: int
    """Version of the format that the file has."""
    digest: str
    """SHA-256 of its body."""
    content: str
    """One line on what it holds."""
    provenance: Provenance
    """Where it comes from."""


def verify(path: Path) -> Verified:
    """Read any file of ours and say what it is.

    Args:
        path: A pendulum, policy or evaluation.

    Raises:
        ArtefactError: The file is missing, not ours, edited, damaged, or newer than this Equipoise.
    """
    document = read_document(path)
    kind = document["format"]
    if kind not in _KINDS:
        raise ArtefactError(
            f"{path} holds {kind!r}, expected one of {', '.join(_KINDS)}; "
            "was it written by a newer Equipoise? Then upgrade this one"
        )
    what, artefact, content = _KINDS[kind]
    value = artefact.load(path)
    return Verified(
        what=what,
        format=kind,
        version=document["version"],
        digest=document["digest"],
        content=content(value),
        provenance=_provenance(path, document["provenance"]),
    )


def _provenance(path: Path, given: Mapping[str, Any]) -> Provenance:
    try:
        return Provenance.model_validate(given)
    except ValueError:
        raise ArtefactError(
            f"{path} does not say where it comes from: its provenance is damaged; "
            "make the file again"
        ) from None


def _pendulum(pendulum: Pendulum) -> str:
    fit = pendulum.fit
    origin = f"from {fit.source}, {fit.rms_deg:.3g} deg RMS" if fit else "not measured"
    if fit and fit.quantity == "rate":
        origin += "/s"
    return (
        f"w2 = {pendulum.w2.value:.4g} 1/s^2, c = {pendulum.c.value:.3g} 1/s, "
        f"{pendulum.friction_model} friction, {origin}"
    )


def _policy(policy: TabularPolicy) -> str:
    return (
        f"{len(policy.Q)} boxes by {len(policy.actions)} actions for the {policy.arm.name}, recipe "
        f"{policy.recipe}, {policy.episodes:,} episodes, seed {policy.seed}"
    )


def _evaluation(evaluation: Evaluation) -> str:
    summary = evaluation.results.summary()
    return (
        f"{summary.survived} of {summary.trials} trials lasted {evaluation.duration:g} s on the "
        f"{evaluation.arm}, world {evaluation.world}, seed {evaluation.seed}"
    )


_KINDS: Mapping[str, tuple[str, type[Artefact], Callable[[Any], str]]] = {
    Pendulum.FORMAT: ("pendulum", Pendulum, _pendulum),
    TabularPolicy.FORMAT: ("policy", TabularPolicy, _policy),
    Evaluation.FORMAT: ("evaluation", Evaluation, _evaluation),
}
