"""Write all that the design gives: python make.py (or `make hardware` in the folder above).

| what | where |
| --- | --- |
| solids and prints of each part | `step/`, `print/` |
| entries of `rig.toml`, and the numbers of a twin | `rig-iiwa7.toml`, `rig-fr3.toml`, `twin.toml` |
| shapes of the mechanism for pictures of the rig | `src/equipoise/data/mechanism.json` |
| pictures | `pictures/`, with `--pictures` |

Equal designs give equal bytes: no file has a date but a fixed one.
"""

import json
import sys
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from build123d import Part, Solid, export_step

import parts
from clearance import base_rotation
from design import MM, Design
from equipoise.arm.arm import Arm
from equipoise.arm.urdf import read_arm
from equipoise.rig.config import RigSettings
from equipoise.simulation.twin.physics import rod_centre
from mechanism import Mechanism, build

FOLDER: Final = Path(__file__).resolve().parent
SHAPES: Final = FOLDER.parent / "src" / "equipoise" / "data" / "mechanism.json"
DATE: Final = "2000-01-01T00:00:00"
"""Date in STEP files: always the same."""
TOLERANCE: Final = 0.04
"""Largest distance of a print's triangles from the solid [mm]."""
RIGS: Final = ("iiwa7", "fr3")
"""Arms whose `rig.toml` is written; an iiwa 14 differs by its name alone."""


def write_step(path: Path, solid: Part | Solid) -> None:
    """Write a solid as STEP, in millimetres, without blanks at the ends of lines."""
    export_step(solid, path, write_pcurves=False, timestamp=DATE)
    lines = path.read_text().splitlines()
    path.write_text("".join(f"{line.rstrip()}\n" for line in lines))


def write_3mf(path: Path, solid: Part | Solid) -> None:
    """Write a solid's triangles as 3MF, in millimetres; equal solids give equal bytes."""
    vertices, faces = solid.tessellate(TOLERANCE, 0.2)
    points = "".join(f'<vertex x="{v.X:.4f}" y="{v.Y:.4f}" z="{v.Z:.4f}"/>' for v in vertices)
    triangles = "".join(f'<triangle v1="{a}" v2="{b}" v3="{c}"/>' for a, b, c in faces)
    head = '<?xml version="1.0" encoding="UTF-8"?>\n'
    schema = "http://schemas.microsoft.com/3dmanufacturing"
    opc = "http://schemas.openxmlformats.org/package/2006"
    model = (
        f'{head}<model unit="millimeter" xmlns="{schema}/core/2015/02"><resources>'
        f'<object id="1" type="model" name="{path.stem}"><mesh><vertices>{points}</vertices>'
        f"<triangles>{triangles}</triangles></mesh></object></resources>"
        '<build><item objectid="1"/></build></model>\n'
    )
    types = (
        f'{head}<Types xmlns="{opc}/content-types"><Default Extension="rels" '
        'ContentType="application/vnd.openxmlformats-package.relationships+xml"/>'
        '<Default Extension="model" '
        'ContentType="application/vnd.ms-package.3dmanufacturing-3dmodel+xml"/></Types>\n'
    )
    relations = (
        f'{head}<Relationships xmlns="{opc}/relationships"><Relationship Id="r" '
        f'Target="/3D/3dmodel.model" Type="{schema}/2013/01/3dmodel"/></Relationships>\n'
    )
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as package:
        for name, text in (
            ("[Content_Types].xml", types),
            ("_rels/.rels", relations),
            ("3D/3dmodel.model", model),
        ):
            package.writestr(zipfile.ZipInfo(name), text, zipfile.ZIP_DEFLATED, 9)


def on_flange(arm: Arm, vector: Any) -> list[float]:
    """Return a vector of the frame of the parts in the flange's frame, shape (3,)."""
    return (base_rotation(arm) @ np.asarray(vector)).tolist()


def rig_toml(arm: Arm, mechanism: Mechanism) -> str:
    """Return the entries of `rig.toml` that the mechanism determines, on an arm."""
    load, R = mechanism.load, base_rotation(arm)
    I = R @ load.inertia @ R.T
    xx, yy, zz, xy, xz, yz = (I[i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)))
    counts = RigSettings().counts_per_rev

    def mm(vector: Sequence[float], digits: int) -> str:
        return ", ".join(f"{round(1e3 * x, digits) + 0.0:.{digits}f}" for x in vector)

    return f"""\
# Entries of rig.toml for the designed mechanism on an {arm.name}, written by `make hardware`.
# Weigh the parts and correct the load. With a media flange, add its height (35 or 61) to the third
# number of pivot_mm and load_mm.
arm = "{arm.name}"
pivot_mm = [{mm(on_flange(arm, mechanism.pivot), 1)}]
load_kg = {load.mass:.3f}           # holder {mechanism.holder.mass:.3f}, pendulum \
{mechanism.pendulum.mass:.3f}
load_mm = [{mm(on_flange(arm, load.centre), 1)}]
counts_per_rev = {counts}

# For the tool in Sunrise.Workbench, or the end effector in Desk: inertia of the same load about its
# centre, in the flange's axes [kg m^2]. The free pendulum counts as a point in the pivot.
# xx = {xx:.2e}, yy = {yy:.2e}, zz = {zz:.2e}
# xy = {xy:.1e}, xz = {xz:.1e}, yz = {yz:.1e}
"""


def twin_toml(mechanism: Mechanism) -> str:
    """Return the differences of a twin with the designed mechanism.

    The twin's pendulum is a uniform rod. One with the same w2 and the same m l reacts on the arm
    like the designed one; the rest of its mass stays in the pivot, and counts to the bracket.
    """
    pendulum = mechanism.pendulum
    uniform = pendulum.mass * mechanism.length / rod_centre(mechanism.w2)
    bracket = mechanism.holder.mass + pendulum.mass - uniform
    return f"""\
# World of a twin with the designed mechanism, written by `make hardware`:
# equipoise evaluate --world twin:hardware/twin.toml --arm hardware/rig-iiwa7.toml
pendulum_mass = {uniform:.4f}  # [kg] uniform rod with w2 and m l of the designed pendulum
bracket_mass = {bracket:.4f}  # [kg] holder, and the rest of the pendulum in the pivot
pivot_outward = {mechanism.design.pivot_outward * MM:g}  # [m]
counts_per_rev = {RigSettings().counts_per_rev}
"""


def shapes_json(mechanism: Mechanism) -> str:
    """Return the mechanism as boxes and cylinders, for pictures of the rig [m].

    Each has the body that carries it, its kind, and the pair of its ends: opposite corners of a
    box, or the ends of a cylinder's axis, with its radius. Those of the flange are in the frame of
    the parts, those of the pendulum from the pivot, with Z along the rod.
    """
    d = mechanism.design
    down, half = d.pivot_down, d.half_width
    lower = down + d.wall_below
    e, collar = d.encoder, 0.5 * d.collar[0]
    steps = [0.25, 0.5, 0.75, 1.0]  # a rib is drawn in as many steps
    ribs: list[Any] = []
    for a, b in zip([0.0, *steps[:-1]], steps, strict=True):
        x0, x1 = (d.rib_start + k * (d.wall_start - d.rib_start) for k in (a, b))
        z = d.plate + 0.5 * (a + b) * (lower - d.plate - 4.0)
        for y in (-half, half - d.rib):
            ribs.append(("flange", "box", (x0, y, d.plate), (x1, y + d.rib, z), 0.0))
    outer = 0.5 * d.bearing.outer + d.block_wall
    hub, spindle_end = d.hub_start - d.pivot_outward, d.spindle_end - d.pivot_outward
    a, b = 0.5 * d.hub_width, 0.5 * d.hub_rod_width
    found = [
        ("flange", "cylinder", (0.0, 0.0, 0.0), (0.0, 0.0, d.plate), 0.5 * d.plate_diameter),
        ("flange", "box", (0.0, -half, 0.0), (d.wall_start, half, d.plate), 0.0),
        ("flange", "box", (d.wall_start, -half, 0.0), (d.wall_end, half, lower), 0.0),
        *ribs,
        ("flange", "box", (d.wall_end, -half, down - d.wall_below),
         (d.wall_end + d.block_flange, half, lower), 0.0),
        ("flange", "cylinder", (d.wall_end, 0.0, down), (d.block_end, 0.0, down), outer),
        ("flange", "box", (d.encoder_face - e.depth, -0.5 * e.height, down - 0.5 * e.height),
         (d.encoder_face, 0.5 * e.height, down + e.connector), 0.0),
        ("pendulum", "box", (hub, -a, -d.hub_back), (hub + d.hub_width, a, d.rod_start), 0.0),
        ("pendulum", "box", (hub, -b, d.rod_start), (d.hub_rod_ear, b, d.hub_end), 0.0),
        ("pendulum", "cylinder", (hub + d.hub_width, 0.0, 0.0), (spindle_end, 0.0, 0.0), collar),
    ]  # fmt: skip
    lines = []
    for body, kind, start, end, radius in found:
        ends = [[round(MM * x, 5) + 0.0 for x in place] for place in (start, end)]
        shape: dict[str, Any] = {"body": body, "kind": kind, "ends": ends}
        if kind == "cylinder":
            shape["radius"] = round(MM * radius, 5)
        lines.append(json.dumps(shape))
    pivot = json.dumps([round(float(x), 5) for x in mechanism.pivot])
    return f'{{"pivot": {pivot}, "shapes": [\n' + ",\n".join(lines) + "\n]}\n"


def write_all(folder: Path, shapes: Path, d: Design | None = None) -> Mechanism:
    """Write all files but the pictures.

    Args:
        folder: Folder of `step`, `print` and the TOML files.
        shapes: File of the shapes for pictures of the rig.
        d: The design.
    """
    d = d or Design()
    mechanism = build(d)
    for name in ("step", "print"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    for name, part in parts.printed(d).items():
        lying = parts.for_print(d, name, part)
        lying.label = name
        write_step(folder / "step" / f"{name}.step", lying)
        write_3mf(folder / "print" / f"{name}.3mf", lying)
    for name in RIGS:
        (folder / f"rig-{name}.toml").write_text(rig_toml(read_arm(name), mechanism))
    (folder / "twin.toml").write_text(twin_toml(mechanism))
    shapes.write_text(shapes_json(mechanism))
    return mechanism


def main() -> None:
    """Write all files, and the pictures if asked for."""
    mechanism = write_all(FOLDER, SHAPES)
    print(
        f"rod {mechanism.rod_length:.1f} mm, period {mechanism.period:.4f} s, pendulum "
        f"{1e3 * mechanism.pendulum.mass:.0f} g, holder {1e3 * mechanism.holder.mass:.0f} g"
    )
    if "--pictures" in sys.argv[1:]:
        from draw import draw_all

        draw_all(mechanism, FOLDER / "pictures")


if __name__ == "__main__":
    main()
