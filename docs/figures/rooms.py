"""Draw rooms.svg, the packages of the code by import layer of pyproject.toml: `make rooms`.

Each band is one layer. A package imports only from bands below, which `lint-imports` enforces.
"""

import tomllib
from html import escape
from pathlib import Path

HERE = Path(__file__).parent
CAPTIONS = {
    "cli": "the command: parses, calls, prints; conformance tests for plugins",
    "console": "live view and operator's console in the browser",
    "report": "figures, animation and HTML page, from saved results",
    "envs": "Gymnasium environments",
    "reproduction": "the whole pipeline in one call",
    "progress": "progress of stages, compilation",
    "training": "the pipeline: one stage each, connected only by values",
    "simulation": "trials in any simulated world; fitness of machine, rig and policy",
    "rigs": "addresses become devices",
    "devices": "robot, encoder, emulators, twin; closed loop and learning",
    "control": "a measurement becomes a command",
    "model": "a command becomes a measurement",
    "trajectory": "recordings and run logs",
    "logs": "recordings and run logs",
    "settings": "every choice, with its unit and its reason",
    "artefacts": "files, compiled kernels, log files, objects of plugins",
    "paper": "the published numbers",
    "views": "plots of values, in scripts and notebooks",
    "errors": "errors, parallel tasks, escaping of printed text, private folders",
}
"""Caption of a layer, by one of its packages."""
HIDDEN = ("__main__",)
"""Modules that are not drawn."""
WIDTH, BAND, GAP, MARGIN, CHARACTER = 980, 34, 8, 14, 8.4
"""Page width, band height, space between boxes, border, width of a character [px]."""
PIPELINE = ("training", "identification", "evaluation", "deployment")


def layers() -> list[list[str]]:
    """Return the packages of each layer, the top layer first."""
    text = (HERE.parents[1] / "pyproject.toml").read_text(encoding="utf-8")
    contracts = tomllib.loads(text)["tool"]["importlinter"]["contracts"]
    contract = next(one for one in contracts if one["type"] == "layers")
    rows = ([room.strip("() ") for room in row.split("|")] for row in contract["layers"])
    return [row for row in rows if row[0] not in HIDDEN]


def draw() -> str:
    """Return the picture as SVG."""
    parts: list[str] = []
    y = MARGIN
    for row in layers():
        x = MARGIN + 26.0
        for room in row:
            width = CHARACTER * len(room) + 22.0
            fill = "#dbe9f6" if room in PIPELINE else "#f1f3f5"
            parts.append(
                f'<rect x="{x:.1f}" y="{y}" width="{width:.1f}" height="{BAND - GAP}" rx="5" '
                f'fill="{fill}" stroke="#8a97a5"/>'
                f'<text x="{x + width / 2:.1f}" y="{y + 18}" text-anchor="middle" class="room">'
                f"{escape(room)}</text>"
            )
            x += width + GAP
        caption = next((CAPTIONS[room] for room in row if room in CAPTIONS), "")
        parts.append(f'<text x="{x + 6:.1f}" y="{y + 18}" class="caption">{escape(caption)}</text>')
        y += BAND
    arrow = (
        f'<path d="M {MARGIN + 6} {MARGIN} V {y - GAP - 6}" stroke="#8a97a5" stroke-width="2"/>'
        f'<path d="M {MARGIN} {y - GAP - 8} h 12 l -6 9 z" fill="#8a97a5"/>'
    )
    style = (
        "<style>.room{font:14px ui-monospace,monospace;fill:#1f2933}"
        ".caption{font:13px system-ui,sans-serif;fill:#52606d}</style>"
    )
    height = y + MARGIN - GAP
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height}" '
            f'width="{WIDTH}" height="{height}" role="img">',
            "<title>Packages of the code; imports go down</title>",
            style,
            f'<rect width="{WIDTH}" height="{height}" fill="#ffffff"/>',
            arrow,
            *parts,
            "</svg>\n",
        ]
    )


if __name__ == "__main__":
    (HERE / "rooms.svg").write_text(draw(), encoding="utf-8")
