"""Verification of Equipoise's files: kind, content, and integrity.

A file states its format, version, digest and provenance. It is read in full by the rules of its
kind, so that a verified file is usable. A certificate is also compared with its trials, if they are
beside it.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from equipoise.artefacts import Artefact, Provenance, StrPath, read_document
from equipoise.control.policy import TabularPolicy
from equipoise.errors import ArtefactError
from equipoise.evaluation import Evaluation
from equipoise.logs.run_log import RunLog
from equipoise.logs.writer import FORMAT, VERSION
from equipoise.model.actuator import Actuator
from equipoise.model.pendulum import Pendulum
from equipoise.studies.certification import Certificate, check_evaluation, evaluation_path
from equipoise.studies.formatting import format_failures
from equipoise.studies.gap_results import Gap
from equipoise.studies.recovery_map import RecoveryMap
from equipoise.studies.results import StageRecord
from equipoise.studies.runs import summarise

MCAP = b"\x89MCAP"
"""First bytes of an MCAP file."""


class Verified(NamedTuple):
    """A verified file."""

    what: str
    """Kind of the file in a word or two."""
    format: str
    """Name of its format."""
    version: int
    """Version of the format."""
    digest: str | None
    """SHA-256 of its body."""
    content: str
    """Summary of the content in one line."""
    provenance: Provenance | None
    """Origin of the file."""
    lines: tuple[tuple[str, str], ...] = ()
    """Names and texts of further lines, for a run log."""


def verify(path: StrPath) -> Verified:
    """Read a file of Equipoise and describe it.

    Args:
        path: A pendulum, policy, evaluation, certificate, reproduction or run log.

    Raises:
        ArtefactError: The file is missing, of another kind, edited, damaged, or newer than this
            Equipoise; or a certificate does not match the trials beside it.
    """
    path = Path(path)
    if _is_mcap(path):
        run = RunLog.load(path)
        lines = tuple(summarise(run).items())
        return Verified("run log", FORMAT, VERSION, run.digest, _run(run), run.provenance, lines)
    document = read_document(path)
    kind = document["format"]
    if kind not in _KINDS:
        raise ArtefactError(
            f"{path} holds {kind!r}, expected one of {', '.join(_KINDS)}; "
            "was it written by a newer Equipoise? Then upgrade this one"
        )
    what, artefact, content = _KINDS[kind]
    value = artefact.load(path)
    if isinstance(value, Certificate) and (trials := evaluation_path(path)).exists():
        check_evaluation(value, trials)
    try:
        provenance = Provenance.model_validate(document["provenance"])
    except ValueError:
        raise ArtefactError(f"{path} has a damaged provenance; make the file again") from None
    version, digest = document["version"], document["digest"]
    return Verified(what, kind, version, digest, content(value), provenance)


def _is_mcap(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            return file.read(len(MCAP)) == MCAP
    except OSError:
        return False  # `read_document` raises the error


def _pendulum(pendulum: Pendulum) -> str:
    origin = "not measured"
    if fit := pendulum.fit:
        unit = "deg/s" if fit.quantity == "rate" else "deg"
        origin = f"from {fit.source} with {fit.rms_deg:.3g} {unit} RMS"
    return (
        f"w2 = {pendulum.w2.value:.4g} 1/s^2, c = {pendulum.c.value:.3g} 1/s, "
        f"{pendulum.friction_model} friction, {origin}"
    )


def _actuator(actuator: Actuator) -> str:
    delay, fit = 1e3 * actuator.delay.value, actuator.fit
    origin = f"from a log of {fit.duration:.1f} s" if fit else "not measured"
    return f"servo law {actuator.kind}, transport delay {delay:.1f} ms, {origin}"


def _gap(gap: Gap) -> str:
    form = ", the short form" if gap.quick else ""
    trials = f"{gap.trials} trials of {gap.duration:g} s per point"
    return f"cost of each effect of {gap.world}{form}, {trials}"


def _map(found: RecoveryMap) -> str:
    trials = sum(len(one.starts) for one in found.slices)
    share = found.slices[0].held_share("necessary")
    return (
        f"recoverable set on the {found.arm}, world {found.world}, {trials:,} starts; the policy "
        f"holds {100.0 * share.share:.1f} % of it"
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


def _certificate(certificate: Certificate) -> str:
    claim = certificate.claim
    return (
        f"{'granted' if certificate.granted else 'refused'}: the {certificate.arm}'s policy "
        f"{certificate.policy[:19]}... {claim.text}; {claim.trials:,} trials, "
        f"{format_failures(certificate.failures)}, {max(claim.allowed, 0):,} failures allowed"
    )


def _reproduction(record: StageRecord) -> str:
    run, wall = f"run from {record.swing}", sum(stage.wall for stage in record.stages)
    run = f"a quick {run}" if record.quick else run
    return f"{run}, seed {record.seed}, {len(record.files)} files, {wall:.0f} s"


def _run(run: RunLog) -> str:
    conditions = run.conditions
    where = "world" if conditions.simulated else "robot"
    return (
        f"{run.lasted:g} s of {conditions.duration:g} s on the {conditions.arm.name}, {where} "
        f"{conditions.world}, {len(run.tables['tick']):,} ticks, ended: {run.cause}"
    )


_KINDS: Mapping[str, tuple[str, type[Artefact], Callable[[Any], str]]] = {
    Pendulum.FORMAT: ("pendulum", Pendulum, _pendulum),
    Actuator.FORMAT: ("actuator", Actuator, _actuator),
    TabularPolicy.FORMAT: ("policy", TabularPolicy, _policy),
    Evaluation.FORMAT: ("evaluation", Evaluation, _evaluation),
    Gap.FORMAT: ("gap study", Gap, _gap),
    RecoveryMap.FORMAT: ("map", RecoveryMap, _map),
    Certificate.FORMAT: ("certificate", Certificate, _certificate),
    StageRecord.FORMAT: ("reproduction", StageRecord, _reproduction),
}
