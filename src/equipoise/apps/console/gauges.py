"""Gauges, state and messages of the console, as HTML and SVG.

All texts are escaped here: they come from logs, plugins and devices.
"""

from collections.abc import Iterable
from html import escape
from math import cos, degrees, isfinite, radians, sin
from typing import Final

from equipoise.apps.report.style import BLUE, GREEN, GREY, INK, ORANGE, PALE, VERMILION, typeset
from equipoise.logs.recorder import LoggedEvent
from equipoise.outcomes import Phase
from equipoise.paper import PHI_LIMIT_DEG, X_LIMIT
from equipoise.printable import printable

DIAL_DEG: Final = 15.0
"""Largest angle on the dial [deg]; the needle of a larger one stays there."""
DIAL_STRETCH: Final = 4.0
"""Angle on the screen for an angle of the pendulum [-]."""
TRACK: Final = 0.25
"""Largest displacement on the track [m]."""
PHASE_COLOURS: Final = {
    Phase.BALANCING: GREEN,
    Phase.ARMED: GREEN,
    Phase.STOPPING: VERMILION,
}
"""Colours of the phases; the others are blue."""
VERDICT_COLOURS: Final = {"good": GREEN, "warning": "#8a5a00", "bad": VERMILION}
EVENT_COLOURS: Final = {"fault": VERMILION, "stopping": VERMILION, "warning": "#8a5a00"}
SIZE: Final = "width:100%;max-width:260px;display:block;margin:4px auto"
FONT: Final = "font:14px/1.4 system-ui,sans-serif"


def shown(text: str) -> str:
    """Return untrusted text for HTML."""
    return escape(printable(text))


def gauges(phi: float, x: float) -> str:
    """Return the dial of the angle and the track of the flange as SVG.

    Args:
        phi: Angle from upright [rad]; NaN while unknown.
        x: Displacement of the flange [m]; NaN while unknown.
    """
    angle = f"φ = {degrees(phi):+.2f}°" if isfinite(phi) else "φ unknown"
    place = f"x = {1e3 * x:+.1f} mm" if isfinite(x) else "x unknown"
    return (
        f'<svg viewBox="0 0 320 178" role="img" aria-label="{typeset(angle)}, {typeset(place)}" '
        f'style="{SIZE}" font-family="system-ui,sans-serif" fill="{INK}">'
        f"{_dial(phi)}{_track(x)}"
        f'<text x="160" y="112" text-anchor="middle" font-size="17">{typeset(angle)}</text>'
        f'<text x="160" y="172" text-anchor="middle" font-size="17">{typeset(place)}</text></svg>'
    )


def _dial(phi: float) -> str:
    """Return the dial: upright at the top, the limit of a trial in red."""
    limit = PHI_LIMIT_DEG
    arcs = [
        _arc(-limit, limit, GREEN),
        _arc(-DIAL_DEG, -limit, VERMILION),
        _arc(limit, DIAL_DEG, VERMILION),
    ]
    marks = "".join(
        f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="middle" font-size="11">{each:+g}°</text>'
        for each in (-limit, limit)
        for x, y in [_on_dial(each, 92.0)]
    )
    if not isfinite(phi):
        return "".join(arcs) + marks
    x, y = _on_dial(max(-DIAL_DEG, min(DIAL_DEG, degrees(phi))), 68.0)
    colour = INK if abs(degrees(phi)) < limit else VERMILION
    needle = f'<path d="M160 92L{x:.1f} {y:.1f}" stroke="{colour}" stroke-width="5" '
    return (
        "".join(arcs) + marks + f'{needle}stroke-linecap="round"/><circle cx="160" cy="92" r="6"/>'
    )


def _on_dial(angle_deg: float, radius: float) -> tuple[float, float]:
    turned = radians(DIAL_STRETCH * angle_deg)
    return 160.0 + radius * sin(turned), 92.0 - radius * cos(turned)


def _arc(begin_deg: float, end_deg: float, colour: str) -> str:
    (x0, y0), (x1, y1) = (_on_dial(each, 78.0) for each in (begin_deg, end_deg))
    path = f"M{x0:.1f} {y0:.1f}A78 78 0 0 1 {x1:.1f} {y1:.1f}"
    return f'<path d="{path}" fill="none" stroke="{colour}" stroke-width="7"/>'


def _track(x: float) -> str:
    """Return the track with its ends, and the flange on it."""

    def place(metres: float) -> float:
        return 160.0 + 140.0 * metres / TRACK

    def bar(begin: float, end: float, colour: str) -> str:
        width = place(end) - place(begin)
        return (
            f'<rect x="{place(begin):.1f}" y="138" width="{width:.1f}" height="6" fill="{colour}"/>'
        )

    parts = [
        bar(-X_LIMIT, X_LIMIT, GREEN),
        bar(-TRACK, -X_LIMIT, VERMILION),
        bar(X_LIMIT, TRACK, VERMILION),
        f'<rect x="159" y="134" width="2" height="14" fill="{GREY}"/>',
    ]
    parts += [
        f'<text x="{place(end):.1f}" y="160" text-anchor="middle" font-size="11">{end:+g} m</text>'
        for end in (-X_LIMIT, X_LIMIT)
    ]
    if isfinite(x):
        at = place(max(-TRACK, min(TRACK, x)))
        colour = INK if abs(x) < X_LIMIT else VERMILION
        parts.append(
            f'<rect x="{at - 9.0:.1f}" y="128" width="18" height="22" rx="4" fill="{colour}"/>'
        )
    return "".join(parts)


def state_card(phase: str, colour: str, lines: Iterable[str]) -> str:
    """Return the state of the run in large letters, and lines below it.

    Args:
        phase: The state, one or two words.
        colour: Colour of its background.
        lines: Sentences.
    """
    below = "".join(f'<div style="overflow-wrap:anywhere">{shown(line)}</div>' for line in lines)
    return (
        f'<div id="equipoise-state" style="{FONT};padding:0 9px 4px">'
        f'<div style="background:{colour};color:#fff;'
        'font-weight:700;font-size:20px;padding:6px 12px;border-radius:8px;margin-bottom:6px">'
        f"{shown(phase)}</div>{below}</div>"
    )


def question_card(text: str) -> str:
    """Return a question for the operator."""
    return (
        f'<div id="equipoise-question" style="{FONT};margin:0 9px;font-size:16px;font-weight:600;'
        f'border-left:5px solid {ORANGE};background:#fff7e6;padding:8px 10px">{shown(text)}</div>'
    )


def checks_table(findings: Iterable[LoggedEvent]) -> str:
    """Return the results of the pre-flight, each with its remedy."""
    rows: list[str] = []
    for event in findings:
        name, verdict, found, cure = (*event.text.split("\t"), "", "", "")[:4]  # may be truncated
        colour = VERDICT_COLOURS.get(verdict, GREY)
        remedy = f'<div style="color:{GREY}">{shown(cure)}</div>' if cure else ""
        rows.append(
            f'<tr style="border-top:1px solid {PALE};vertical-align:top">'
            f'<td style="color:{colour};font-weight:600;padding-right:8px">{shown(verdict)}</td>'
            f'<td style="overflow-wrap:anywhere">{shown(name)}: {shown(found)}{remedy}</td></tr>'
        )
    return f'<table style="{FONT};font-size:13px;border-collapse:collapse">{"".join(rows)}</table>'


def messages_list(events: Iterable[LoggedEvent]) -> str:
    """Return messages of the run, the newest first."""
    rows = (
        f'<div style="border-top:1px solid {PALE};overflow-wrap:anywhere;'
        f'color:{EVENT_COLOURS.get(event.name, INK)}">{shown(event.text or event.name)}</div>'
        for event in reversed(list(events))
    )
    return f'<div id="equipoise-messages" style="{FONT};font-size:13px">{"".join(rows)}</div>'


def phase_colour(phase: Phase | None) -> str:
    """Return the colour of a phase."""
    return BLUE if phase is None else PHASE_COLOURS.get(phase, BLUE)
