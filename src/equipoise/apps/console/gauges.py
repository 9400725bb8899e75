"""Gauges, state and messages of the pages, as HTML and SVG.

All texts are escaped here: they come from logs, plugins and devices.
"""

from collections.abc import Iterable
from html import escape
from math import cos, degrees, isfinite, radians, sin
from typing import Final

from equipoise.apps.style import GREEN, GREY, INK, ORANGE, PALE, VERMILION, typeset
from equipoise.paper import PHI_LIMIT_DEG, X_LIMIT
from equipoise.printable import printable

DIAL_DEG: Final = 15.0
"""Largest angle on the dial [deg]; the needle of a larger one stays there."""
DIAL_STRETCH: Final = 4.0
"""Angle on the screen for an angle of the pendulum [-]."""
TRACK: Final = 0.25
"""Largest displacement on the track [m]."""
FONT: Final = "font:14px/1.4 system-ui,sans-serif;padding:2px 9px;overflow-wrap:anywhere"


def shown(text: str) -> str:
    """Return untrusted text for HTML."""
    return escape(printable(text))


def gauges(phi: float, x: float) -> str:
    """Return the dial of the angle and the track of the flange as SVG.

    Args:
        phi: Angle from upright [rad]; NaN while unknown.
        x: Displacement of the flange [m]; NaN while unknown.
    """
    angle = typeset(f"φ = {degrees(phi):+.2f}°" if isfinite(phi) else "φ unknown")
    place = typeset(f"x = {1e3 * x:+.1f} mm" if isfinite(x) else "x unknown")
    return (
        f'<svg viewBox="0 0 320 178" role="img" aria-label="{angle}, {place}" style="width:100%;'
        'max-width:260px;display:block;margin:4px auto" font-family="system-ui,sans-serif" '
        f'fill="{INK}" text-anchor="middle">{_dial(phi)}{_track(x)}'
        f'<text x="160" y="112" font-size="17">{angle}</text>'
        f'<text x="160" y="172" font-size="17">{place}</text></svg>'
    )


def _dial(phi: float) -> str:
    """Return the dial: upright at the top, angles beyond the limit of a trial in red."""

    def place(angle_deg: float, radius: float) -> str:
        turned = radians(DIAL_STRETCH * angle_deg)
        return f"{160.0 + radius * sin(turned):.1f} {92.0 - radius * cos(turned):.1f}"

    limit, parts = PHI_LIMIT_DEG, list[str]()
    for begin, end, colour in (
        (-DIAL_DEG, -limit, VERMILION),
        (-limit, limit, GREEN),
        (limit, DIAL_DEG, VERMILION),
    ):
        arc = f"M{place(begin, 78.0)}A78 78 0 0 1 {place(end, 78.0)}"
        parts.append(f'<path d="{arc}" fill="none" stroke="{colour}" stroke-width="7"/>')
    for angle in (-limit, limit):
        x, y = place(angle, 92.0).split()
        parts.append(f'<text x="{x}" y="{y}" font-size="11">{angle:+g}°</text>')
    if isfinite(phi):
        colour = INK if abs(degrees(phi)) < limit else VERMILION
        tip = place(max(-DIAL_DEG, min(DIAL_DEG, degrees(phi))), 68.0)
        parts.append(
            f'<path d="M160 92L{tip}" stroke="{colour}" stroke-width="5" stroke-linecap="round"/>'
            '<circle cx="160" cy="92" r="6"/>'
        )
    return "".join(parts)


def _track(x: float) -> str:
    """Return the track with its ends, and the flange on it."""

    def place(metres: float) -> float:
        return 160.0 + 140.0 * metres / TRACK

    def bar(begin: float, end: float, top: float, height: float, colour: str) -> str:
        return (
            f'<rect x="{place(begin):.1f}" y="{top:g}" width="{place(end) - place(begin):.1f}" '
            f'height="{height:g}" fill="{colour}"/>'
        )

    parts = [bar(-TRACK, TRACK, 138, 6, VERMILION), bar(-X_LIMIT, X_LIMIT, 138, 6, GREEN)]
    parts.append(bar(-0.002, 0.002, 134, 14, GREY))
    for end in (-X_LIMIT, X_LIMIT):
        parts.append(f'<text x="{place(end):.1f}" y="160" font-size="11">{end:+g} m</text>')
    if isfinite(x):
        at = max(-TRACK, min(TRACK, x))
        parts.append(bar(at - 0.016, at + 0.016, 128, 22, INK if abs(x) < X_LIMIT else VERMILION))
    return "".join(parts)


def state_card(name: str, colour: str, lines: Iterable[str]) -> str:
    """Return the state of a run in large letters, and sentences below it.

    Args:
        name: The state, one or two words.
        colour: Colour of its background.
        lines: Sentences.
    """
    below = "".join(f"<div>{shown(line)}</div>" for line in lines if line)
    return (
        f'<div id="equipoise-state" style="{FONT}"><div style="background:{colour};color:#fff;'
        'font-weight:700;font-size:20px;padding:6px 12px;border-radius:8px;margin-bottom:6px">'
        f"{shown(name)}</div>{below}</div>"
    )


def question_card(text: str) -> str:
    """Return a question for the operator."""
    return (
        f'<div id="equipoise-question" style="{FONT};margin:0 9px;font-size:16px;font-weight:600;'
        f'border-left:5px solid {ORANGE};background:#fff7e6">{shown(text)}</div>'
    )


def note(text: str, name: str = "note") -> str:
    """Return a small sentence; `name` ends its id."""
    return f'<div id="equipoise-{name}" style="{FONT};font-size:13px">{shown(text)}</div>'


def messages_list(messages: Iterable[tuple[str, str]]) -> str:
    """Return messages, each with its colour, the newest first."""
    rows = (
        f'<div style="border-top:1px solid {PALE};color:{colour}">{shown(text)}</div>'
        for text, colour in reversed(list(messages))
    )
    return f'<div id="equipoise-messages" style="{FONT};font-size:13px">{"".join(rows)}</div>'
