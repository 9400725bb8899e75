"""Pictures of the page: parts, assembly in steps, the rig, clearance over turn and track."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final

import matplotlib
import mujoco
import numpy as np
from build123d import Axis, Part, Solid
from PIL import Image

import parts
import pictures
from checks import ARMS
from clearance import LEAST, TRACK, TURN, base_rotation, clearance
from equipoise.arm.urdf import read_arm
from equipoise.film import SLIM
from mechanism import Mechanism

matplotlib.use("Agg")

WEBP: Final = {"quality": 80, "method": 6}


def draw_all(mechanism: Mechanism, folder: Path) -> None:
    """Write all pictures into a folder."""
    folder.mkdir(exist_ok=True)
    draw_parts(mechanism).save(folder / "parts.webp", **WEBP)
    draw_exploded(mechanism).save(folder / "exploded.webp", **WEBP)
    for number, image in enumerate(draw_steps(mechanism), 1):
        image.save(folder / f"step-{number}.webp", **WEBP)
    for name in ("iiwa7", "fr3"):
        draw_rig(mechanism, name).save(folder / f"rig-{name}.webp", **WEBP)
    draw_clearance(mechanism, folder / "clearance.png")


def named(mechanism: Mechanism, *starts: str) -> dict[str, Part | Solid]:
    """Return the solids whose names begin with one of some words."""
    return {name: s for name, s in mechanism.solids.items() if name.startswith(starts)}


def draw_parts(mechanism: Mechanism) -> Image.Image:
    """Return the printed parts as they lie on the printer's bed."""
    d, images = mechanism.design, []
    for name, part in parts.printed(d).items():
        lying = parts.for_print(d, name, part).rotate(Axis.X, 180.0)
        size = lying.bounding_box().size
        text = f"{name}: {size.X:.0f} × {size.Y:.0f} × {size.Z:.0f} mm"
        images.append(
            pictures.label(pictures.picture({name: lying}, 130.0, -30.0, (420, 320)), text)
        )
    return pictures.row(images, 3)


def draw_exploded(mechanism: Mechanism) -> Image.Image:
    """Return the mechanism pulled apart along the spindle."""
    along = {
        "encoder": -120.0,
        "encoder_plate": -55.0,
        "base": 0.0,
        "bearing_block": 75.0,
        "inner bearing": 45.0,
        "outer bearing": 110.0,
        "spacer": 22.0,
        "inner collar": -18.0,
        "spindle": 150.0,
        "hub": 205.0,
        "outer collar": 240.0,
        "rod": 205.0,
        "screw block": 120.0,
        "screw plate": -75.0,
        "screw encoder": -160.0,
        "screw hub": 205.0,
        "screw flange": 0.0,
    }
    moved = {}
    for name in mechanism.solids:
        key = next(k for k in (name, name.rsplit(" ", 1)[0]) if k in along)
        moved[name] = (along[key], 0.0, 0.0)
        if name.startswith("screw flange"):
            moved[name] = (0.0, 0.0, 30.0)
        if name.startswith("screw hub"):
            moved[name] = (205.0, 22.0, 0.0)
        if name == "rod":
            moved[name] = (205.0, 0.0, 30.0)
    shown = {name: s for name, s in mechanism.solids.items() if name != "rod"}
    short = parts.rod(mechanism.design, 70.0)  # a part of it, so that the rest is large
    return pictures.picture(shown | {"rod": short}, 68.0, 20.0, (1000, 440), moved)


def draw_steps(mechanism: Mechanism) -> list[Image.Image]:
    """Return the steps of the assembly."""
    m = mechanism
    steps: list[tuple[dict[str, Any], dict[str, Any], float, float]] = []

    def step(
        shown: Iterable[str], new: dict[str, tuple[float, float, float]], view: tuple[float, float]
    ) -> None:
        solids = named(m, *shown, *new)
        moved = {
            name: vector
            for name in solids
            for start, vector in new.items()
            if name.startswith(start)
        }
        steps.append((solids, moved, *view))

    step(("bearing_block",), {"inner bearing": (-25, 0, 0), "outer bearing": (25, 0, 0)}, (35, -20))
    step(
        ("base",),
        {"bearing_block": (30, 0, 0), "inner b": (30, 0, 0), "outer b": (30, 0, 0),
         "screw block": (60, 0, 0)},
        (140, -22),
    )  # fmt: skip
    step(
        ("base", "bearing_block", "inner b", "outer b", "screw block"),
        {"spindle": (60, 0, 0), "spacer": (-30, 0, 0), "inner collar": (-50, 0, 0)},
        (40, 20),
    )
    fixed = ("base", "bearing_block", "inner", "outer b", "screw block", "spindle", "spacer")
    step(
        fixed,
        {"encoder_plate": (-25, 0, 0), "screw plate": (-45, 0, 0)},
        (30, 24),
    )
    fixed = (*fixed, "encoder_plate", "screw plate")
    step(fixed, {"encoder": (-25, 0, 0), "screw encoder": (-50, 0, 0)}, (30, 24))
    fixed = (*fixed, "encoder", "screw encoder")
    step(
        fixed,
        {"hub": (30, 0, 0), "outer collar": (55, 0, 0), "screw hub": (30, 25, 0)},
        (140, -18),
    )
    on_flange = {"rod": (0.0, 0.0, 25.0), "screw flange": (0.0, 0.0, 40.0)}
    step((*fixed, "hub", "outer collar", "screw hub"), on_flange, (130, -8))
    steps[-1][0]["rod"] = parts.rod(m.design, 80.0)  # a part of it, so that the rest is large
    return [
        pictures.label(pictures.picture(solids, a, e, (520, 420), moved), str(number))
        for number, (solids, moved, a, e) in enumerate(steps, 1)
    ]


def draw_rig(mechanism: Mechanism, name: str) -> Image.Image:
    """Return the mechanism's solids on an arm in simple geometry, with the pendulum upright."""
    arm = read_arm(name, pivot=tuple(base_rotation(read_arm(name)) @ mechanism.pivot))
    model = _rig_model(mechanism, arm)
    data = mujoco.MjData(model)
    data.qpos[:] = [*arm.home, 0.35]
    mujoco.mj_forward(model, data)
    flange = data.body("flange").xpos
    far = np.array([[-0.08, -0.1, -0.09], [0.1, 0.16, 0.2]]) + flange
    corners = np.array(
        [[far[i, 0], far[j, 1], far[k, 2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)]
    )
    return pictures.draw(model, 215.0, -16.0, (760, 620), corners, data)


def _rig_model(mechanism: Mechanism, arm: Any) -> Any:
    """Return the film's scene of an arm, with the solids in place of its boxes."""
    from equipoise.arm.scene import scene

    spec = scene(arm, SLIM)
    for geom in list(spec.geoms):
        if geom.name.split()[0] in ("bracket", "rod", "table"):
            spec.delete(geom)
    hand = [geom for geom in spec.geoms if geom.name.startswith("link")][-1]
    hand.type = mujoco.mjtGeom.mjGEOM_CYLINDER
    for geom in spec.geoms:
        geom.rgba = (0.90, 0.90, 0.91, 1.0)
    R = base_rotation(arm)
    turning = ("spindle", "spacer", "hub", "rod", "inner collar", "outer collar")
    for part, solid in mechanism.solids.items():
        vertices, faces = pictures.triangles(solid, 0.1)
        points = vertices * 1e-3
        if part in turning or part.startswith("screw hub"):
            body, x, y = "pendulum", *(np.array(arm.pivot[:2]) / np.hypot(*arm.pivot[:2]))
            out = arm.kinematics(arm.home_free).rotation @ [x, y, 0.0]
            points = points - mechanism.pivot
            axes = np.column_stack([out, np.cross([0.0, 0.0, 1.0], out), [0.0, 0.0, 1.0]])
            points = points @ axes.T
        else:
            body, points = "flange", points @ R.T
        flat = points[faces.ravel()]
        mesh = spec.add_mesh(name=part, uservert=flat.ravel())
        mesh.userface = np.arange(len(flat), dtype=np.int32)
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
        colour = pictures.COLOURS.get(part.split()[0], pictures.METAL)
        kind = mujoco.mjtGeom.mjGEOM_MESH
        spec.body(body).add_geom(name=part, type=kind, meshname=part, rgba=colour)
    pictures.finish(spec)
    return spec.compile()


def draw_clearance(mechanism: Mechanism, path: Path) -> None:
    """Write the figure of clearance over turn and track, one panel for each arm."""
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(1, 3, figsize=(9.0, 3.1), sharey=True, layout="constrained")
    turn = np.degrees(TURN)
    levels = np.arange(0.0, 101.0, 10.0)
    for name, panel in zip(ARMS, axes, strict=True):
        found = clearance(read_arm(name), mechanism).turn * 1e3
        drawn = panel.contourf(turn, TRACK, found, levels, cmap="viridis")
        row, column = np.unravel_index(found.argmin(), found.shape)
        panel.plot(turn[column], TRACK[row], "o", color="#d55e00", markersize=5)
        panel.set_title(f"{name}: at least {found.min():.0f} mm", fontsize=9)
        panel.set_xlabel("angle from upright [deg]")
        panel.set_xticks([0, 90, 180, 270])
    axes[0].set_ylabel("x [m]")
    bar = figure.colorbar(drawn, ax=axes, ticks=np.arange(0, 101, 20))
    bar.set_label(f"clearance [mm]; asked for: {1e3 * LEAST:.0f}")
    figure.savefig(path, dpi=100, metadata={"Software": None})
    plt.close(figure)
