"""Scene that all pages share: the rig in 3-D, and a panel with its state and plots.

The geometry is that of the films (`equipoise.film.build_scene`). Each body of the MuJoCo model is
one mesh, and MuJoCo computes the poses of the bodies. Coordinates are those of the base frame [m],
z upwards. All texts are escaped here: they come from logs, plugins and devices.
"""

import threading
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from html import escape
from math import degrees, isfinite, nan
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from equipoise.arm.arm import Arm
from equipoise.arrays import Array
from equipoise.film import ARROW, ARROW_BELOW, ARROW_PER_U, FOV_DEG, build_scene, camera_axes
from equipoise.paper import PHI_LIMIT, X_LIMIT
from equipoise.physics_engine import mujoco
from equipoise.printable import printable
from equipoise.report.style import BLUE, GREEN, GREY, INK, PALE, PURPLE, VERMILION, typeset

if TYPE_CHECKING:
    import viser


PERIOD: Final = 0.04
"""Time between two pictures [s]."""
SPAN: Final = 10.0
"""Time shown in the plots [s]."""
NAME: Final = "/rig"
"""Name of the rig in the tree of the scene."""
PLOTS: Final = (
    ("φ [deg]", BLUE, 2.0, -2.0),
    ("x [mm]", GREEN, 20.0, -20.0),
    ("u [m/s²]", PURPLE, 2.0, -2.0),
    ("lateness of the ticks [ms]", VERMILION, 1.0, 0.0),
)
"""Title, colour, smallest upper and largest lower end of the axis of each plot."""


class RigPage:
    """A rig in a viser scene, and the panel beside it: state, readings and plots.

    A pose takes one message per moving body. Use `server.atomic()` around several calls that belong
    to one picture.
    """

    def __init__(self, server: "viser.ViserServer", label: str, plots: int = 0) -> None:
        """Fill a server's page.

        Args:
            server: The viser server.
            label: Title of the panel.
            plots: Number of plots, the first of `PLOTS`.
        """
        self._server, self._root, self.lock = server, None, threading.RLock()
        """Lock of what the actions of all browsers and the picture share."""
        server.gui.configure_theme(show_logo=False, show_share_button=False)
        server.gui.set_panel_label(label)
        server.gui.main_panel.dock_right()
        server.gui.main_panel.set_width(380.0)
        server.scene.configure_environment_map("studio", environment_intensity=0.5)
        self._state = server.gui.add_html("", order=0)
        self._readings = server.gui.add_html("", order=40)
        self._plots = [self._add_plot(n, n == plots - 1) for n in range(plots)]

    def on_user_event(self, action: Callable[[Any], object]) -> Callable[[Any], None]:
        """Return a callback that does `action` with an event, locked, if a browser caused it."""

        def callback(event: Any) -> None:
            if event.client_id is not None:
                with self.lock:
                    action(event)

        return callback

    def show_arm(self, arm: Arm) -> None:
        """Show the surroundings of another arm, from the camera of the films; `show` adds it."""
        if self._root is not None:
            self._root.remove()
        scene, rig = self._server.scene, build_scene(arm)
        model, self._home = rig.model, rig.pivot
        self._data = mujoco().MjData(model)
        self._root = scene.add_frame(NAME, show_axes=False)
        self._bodies = _add_bodies(scene, model)
        self.pendulum = self._bodies[model.body("pendulum").id]
        """Mesh of the pendulum, which a mouse may drag."""
        colour: Any = tuple(round(255 * part) for part in ARROW[:3])
        size: Any = {"shaft_radius": 0.008, "head_radius": 0.018, "head_length": 0.03}
        nowhere = np.zeros((1, 2, 3), np.float32)
        self._arrow = scene.add_arrows(f"{NAME}/u", nowhere, colour, visible=False, **size)
        for x, top in zip((-X_LIMIT, X_LIMIT), rig.posts, strict=True):
            place = top + np.array([0.0, 0.0, 0.04])
            scene.add_label(f"{NAME}/post {x:+g}", f"{x:+g} m", position=place)
        camera = self._server.initial_camera  # also of a page that is open already
        camera.fov, camera.look_at = float(np.radians(FOV_DEG)), rig.target
        camera.position = rig.target - rig.distance(1.0) * camera_axes()[2]
        self._q: Array | None = None
        self.show(None, nan)

    def show(self, q: Sequence[float] | Array | None, phi: float, u: float = 0.0) -> float:
        """Show a posture and its readings; return the displacement of the flange [m].

        Args:
            q: Joints, all of them [rad], shape (joints,). They are unknown for None, or where one
                is not finite: the arm stays at its last posture, or hidden without one.
            phi: Angle of the pendulum from upright [rad]. A pendulum whose angle or pivot is
                unknown is hidden.
            u: Commanded acceleration of the flange, shown as an arrow [m/s^2].
        """
        known = q is not None and bool(np.all(np.isfinite(q)))
        self._q = np.array(q, np.float64) if known else self._q
        if self._q is not None:
            self._data.qpos[:] = [*self._q, phi if isfinite(phi) else 0.0]
        mujoco().mj_kinematics(self._data.model, self._data)
        phi_known = known and isfinite(phi)
        for number, mesh in self._bodies.items():
            mesh.position = self._data.xpos[number].copy()
            mesh.wxyz = self._data.xquat[number].copy()
            placed = phi_known if mesh is self.pendulum else self._q is not None
            mesh.visible = placed or number == 0  # the table
        pivot = np.array(self._data.body("pendulum").xpos)
        self._arrow.visible = pushing = known and bool(isfinite(u) and u)
        if pushing:
            start = pivot - np.array([0.0, 0.0, ARROW_BELOW])
            end = start + np.array([ARROW_PER_U * u, 0.0, 0.0])
            self._arrow.points = np.array([[start, end]], np.float32)
        x = float(pivot[0] - self._home[0]) if known else nan
        self._readings.content = readings(phi, x)
        return x

    def describe(self, name: str, colour: str, lines: Iterable[str]) -> None:
        """Show the state of the run in large letters, with sentences below.

        Args:
            name: The state, one or two words.
            colour: Colour of its background.
            lines: Sentences.
        """
        head = f"background:{colour};color:#fff;font-weight:700;font-size:20px;padding:6px 12px"
        below = "".join(f"<div>{shown(line)}</div>" for line in lines if line)
        self._state.content = card("state", f'<div style="{head}">{shown(name)}</div>{below}')

    def draw(self, time: Array, rows: Array) -> None:
        """Draw the plots.

        Args:
            time: Times [s], increasing, shape (n,).
            rows: The quantities in the units of their titles, shape (plots, n); NaN is not drawn,
                nor is a plot with less than two known values.
        """
        for plot, values in zip(self._plots, rows, strict=True):
            known = np.isfinite(values)
            plot.visible = np.count_nonzero(known) > 1
            if plot.visible:
                plot.data = (time[known], values[known])

    def _add_plot(self, number: int, last: bool) -> Any:
        """Add a hidden plot; only the last one has a time axis."""
        title, colour, high, low = PLOTS[number]
        soft = {"min": low, "max": high}
        ends: Any = {end: {"pad": 0.1, "mode": 1, "soft": soft[end]} for end in soft}
        return self._server.gui.add_uplot(
            (np.array([-1.0, 0.0]), np.zeros(2)),
            ({}, {"stroke": colour, "width": 1.5, "points": {"show": False}}),
            title=title,
            scales={"x": {"time": False}, "y": {"range": ends}},
            axes=(
                {"size": 24, "stroke": INK, "show": last},
                {"size": 44, "space": 18, "stroke": INK},
            ),
            legend={"show": False},
            cursor={"show": False},
            height=84 + 24 * last,
            padding=(6, 16, 6, 0),
            order=50.0 + number,
            visible=False,
        )


def _add_bodies(scene: "viser.SceneApi", model: Any) -> dict[int, Any]:
    """Add a mesh for each body, in its colours; return the meshes by the numbers of the bodies."""
    import trimesh
    from trimesh import creation, transformations

    kinds, parts = mujoco().mjtGeom, defaultdict[int, list[Any]](list)
    for geom in map(model.geom, range(model.ngeom)):
        radius, half, _ = geom.size
        match int(geom.type[0]):
            case kinds.mjGEOM_CYLINDER:
                mesh: Any = creation.cylinder(radius, 2.0 * half, sections=24)
            case kinds.mjGEOM_CAPSULE:
                mesh = creation.capsule(2.0 * half, radius, count=(24, 24))
                mesh.apply_translation(-mesh.bounds.mean(axis=0))
            case kinds.mjGEOM_PLANE:  # the floor
                mesh = creation.box([2.0 * radius, 2.0 * half, 0.002])
            case _:
                mesh = creation.box(2.0 * geom.size)
        mesh.apply_transform(transformations.quaternion_matrix(geom.quat))
        mesh.apply_translation(geom.pos)
        mesh.visual.face_colors = np.round(255.0 * geom.rgba).astype(np.uint8)
        parts[int(geom.bodyid[0])].append(mesh)
    concatenate: Any = trimesh.util.concatenate
    return {
        body: scene.add_mesh_trimesh(f"{NAME}/body {body}", concatenate(meshes))
        for body, meshes in parts.items()
    }


def shown(text: str) -> str:
    """Return untrusted text for HTML, without the bell of a terminal."""
    return escape(printable(text.replace("\a", "")))


def card(name: str, html: str, style: str = "") -> str:
    """Return a part of the panel.

    Args:
        name: End of its id.
        html: Content, with untrusted text escaped.
        style: Further style.
    """
    font = "font:14px/1.4 system-ui,sans-serif;padding:2px 9px;overflow-wrap:anywhere"
    return f'<div id="equipoise-{name}" style="{font};{style}">{html}</div>'


def readings(phi: float, x: float) -> str:
    """Return angle and displacement in large letters, red beyond the limits of a trial.

    Args:
        phi: Angle from upright [rad]; NaN while unknown.
        x: Displacement of the flange [m]; NaN while unknown.
    """
    texts: list[str] = []
    for name, value, limit, known in (
        ("φ", phi, PHI_LIMIT, f"{degrees(phi):+.2f}°"),
        ("x", x, X_LIMIT, f"{1e3 * x:+.1f} mm"),
    ):
        colour, text = VERMILION if abs(value) >= limit else INK, typeset(known)
        if not isfinite(value):
            colour, text = GREY, "—"
        look = f"color:{colour};white-space:nowrap;margin-right:14px"
        texts.append(f'<span style="{look}">{name} = {text}</span> ')
    return card("readings", "".join(texts), "font-size:18px;font-weight:600")


def messages_list(messages: Iterable[tuple[str, str]]) -> str:
    """Return messages, each with its colour, the newest first."""
    rows = (
        f'<div style="border-top:1px solid {PALE};color:{colour}">{shown(text)}</div>'
        for text, colour in reversed(list(messages))
    )
    return card("messages", "".join(rows), "font-size:13px")
