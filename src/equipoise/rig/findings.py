"""Findings of the checks before a run: status, values with their units, and a remedy."""

from collections.abc import Iterable, Sequence
from typing import Final, Literal

from equipoise.artefacts import Value
from equipoise.errors import EquipoiseError, InputError

Status = Literal["good", "warning", "bad"]
Values = dict[str, float | int | str]
Fitness = Literal["fit", "usable with care", "not fit"]

UNITS: Final = {"ms": "ms", "s": "s", "mm": "mm", "deg": "deg", "Hz": "Hz", "mps": "m/s"}
"""Units, by the end of the name of a value, after an underscore."""


class Finding(Value):
    """Result of one check."""

    name: str
    """Subject of the check."""
    status: Status
    """Good; a warning, which goes into the log; or bad, which forbids a run."""
    values: Values
    """Values that were found, by name; a unit ends the name, such as `p99_ms`."""
    remedy: str = ""
    """Action that helps; empty for a good result."""

    @property
    def text(self) -> str:
        """Values as a phrase."""
        phrases: list[str] = []
        for name, value in self.values.items():
            label, _, unit = name.rpartition("_")
            shown = f"{value:.4g}" if isinstance(value, float) else str(value)
            if label and unit in UNITS:
                name, shown = label, f"{shown} {UNITS[unit]}"
            phrases.append(f"{name.replace('_', ' ')} {shown}")
        return ", ".join(phrases)


def find(
    name: str, values: Values, remedy: str, *, warning: bool = False, bad: bool = False
) -> Finding:
    """Return a finding, without the remedy where it is good.

    Args:
        name: Subject of the check.
        values: Values that were found.
        remedy: Action that helps.
        warning: Whether a warning is due.
        bad: Whether a run is forbidden.
    """
    status: Status = "bad" if bad else "warning" if warning else "good"
    remedy = "" if status == "good" else remedy
    return Finding(name=name, status=status, values=values, remedy=remedy)


def require(findings: Sequence[Finding], error: type[EquipoiseError] = InputError) -> None:
    """Raise an error that names every bad finding.

    Args:
        findings: The findings.
        error: Type of the error: `OutsideError` where the rig is at fault.

    Raises:
        EquipoiseError: A finding is bad.
    """
    bad = [finding for finding in findings if finding.status == "bad"]
    if bad:
        raise error("; ".join(f"{one.name}: {one.text}; {one.remedy}" for one in bad))


def fitness(findings: Iterable[Finding]) -> Fitness:
    """Return the verdict on machine and rig."""
    statuses = {finding.status for finding in findings}
    if "bad" in statuses:
        return "not fit"
    return "usable with care" if "warning" in statuses else "fit"
