"""Arm and pendulum in 3-D in the browser, from joint angles and phi.

The geometry is that of the still pictures (`apps.report.pictures.scene`). Each body of the
MuJoCo model becomes one mesh per material; MuJoCo computes the poses of the bodies. Coordinates are
those of the base frame [m], z upwards.
"""

from collections import defaultdict
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from equipoise.apps.report.pictures.camera import FOV_DEG, Camera
from equipoise.apps.report.pictures.rendering import ARROW, ARROW_BELOW, ARROW_PER_U
from equipoise.apps.report.pictures.scene import stage
from equipoise.model.arms.arm import Arm
from equipoise.model.physics_engine import mujoco

if TYPE_CHECKING:
    import viser

Floats = npt.NDArray[np.float64]

GHOST_COLOUR: Final = 0, 114, 178
"""RGB colour of the ghost, 0 to 255."""
GHOST_OPACITY: Final = 0.35
"""Opacity of the ghost [-]."""
GHOST_INSET: Final = 0.003
"""Distance of the ghost's surface below the arm's [m]: the arm hides a ghost in its posture."""
SECTIONS: Final = 24
"""Number of faces around a cylinder."""
LABEL_HEIGHT: Final = 0.04
"""Height of a post's label above the post [m]."""
VIEW: Final = 480, 480
"""Size of the picture that shows the whole rig; a wider window shows more at its sides."""
FURTHER: Final = 0.15
"""Additional distance of the camera, as a share of that of the pictures [-]."""
FIGURE_3, FRONT, TOP = VIEWS = ("figure 3", "front", "top")
"""Views of the camera: as in the paper's figure 3, along base -y at the pivot, and from above."""
TURNED: Final = 0.01
"""Smallest motion of a camera that counts as one by the user [m]."""
GRID: Final = 6.0
"""Width of the floor [m]."""


class RigView:
    """A rig in a viser scene: arm, pendulum, table, and the ends of the track.

    Each property that does not change is sent once; a pose takes one message per moving body. Use
    `server.atomic()` around several calls that belong to one picture.
    """

    def __init__(self, server: "viser.ViserServer", arm: Arm, *, name: str = "/rig") -> None:
        """Add a rig at home with a hanging pendulum, and set the camera of new browsers.

        Args:
            server: The viser server.
            arm: The arm.
            name: Name of the rig in the scene tree.
        """
        picture = stage(arm, VIEW)
        self._model, self._data = picture.model, mujoco().MjData(picture.model)
        self._scene, self._name = server.scene, name
        self._shown: dict[str, Floats] = {}
        self._looks: dict[int, tuple[str, float, Floats]] = {}
        self._arrow: Any = None
        self._root = server.scene.add_frame(name, show_axes=False)
        self.pendulum: list[Any] = []
        """Meshes of the pendulum, which a mouse may drag."""
        self._bodies = self._add_bodies("real", (), None)
        self._ghost: dict[int, Any] = {}
        for post in picture.posts:
            place = post.top + np.array([0.0, 0.0, LABEL_HEIGHT])
            server.scene.add_label(f"{name}/post {post.x:+g}", f"{post.x:+g} m", position=place)
        floor = self._model.geom_pos[self._plane()]
        tiles: Any = {"cell_size": 0.25, "section_size": 1.0, "cell_color": (225, 228, 232)}
        server.scene.add_grid(
            f"{name}/floor",
            *(GRID, GRID),
            position=tuple(floor.tolist()),
            section_color=(200, 205, 210),
            **tiles,
        )
        self._q, self._phi = np.array(arm.home), np.pi
        self._pose(self._q, self._phi)
        self._home = self.pivot
        self._views = _views(picture.camera, self._home)
        if not server.get_clients():  # it would move the cameras of those, after `keep_in_view`
            view = server.initial_camera
            view.fov = float(np.radians(FOV_DEG))
            view.position, view.look_at = self._views[FIGURE_3]
        self.show(self._q, self._phi)

    @property
    def pivot(self) -> Floats:
        """Position of the pendulum's pivot in the posture shown last [m], shape (3,)."""
        return np.array(self._data.body("pendulum").xpos)

    @property
    def q(self) -> Floats:
        """All joints of the posture shown last [rad], shape (joints,)."""
        return self._q.copy()

    @property
    def x(self) -> float:
        """Displacement of the pivot from home along x in the posture shown last [m]."""
        return float(self.pivot[0] - self._home[0])

    def show(
        self,
        q: Sequence[float] | Floats,
        phi: float,
        *,
        commanded: Sequence[float] | Floats | None = None,
        u: float = 0.0,
    ) -> None:
        """Show a posture.

        Args:
            q: Measured joints, all of them [rad], shape (joints,). A posture that is not finite is
                ignored: the last one stays.
            phi: Angle of the pendulum from upright [rad]; the last one stays for NaN.
            commanded: Commanded joints of the ghost [rad], shape (joints,); without them, or in the
                posture of the arm, the ghost is hidden.
            u: Commanded acceleration of the flange, shown as an arrow [m/s^2].
        """
        if np.all(np.isfinite(q)):
            self._q = np.array(q, np.float64)
        self._phi = float(phi) if np.isfinite(phi) else self._phi
        wanted = commanded is not None and bool(np.all(np.isfinite(commanded)))
        if wanted and commanded is not None:
            self._pose(self._q, self._phi)
            measured = np.array(self._data.xpos)
            self._pose(np.array(commanded, np.float64), self._phi)
            # Inside the arm it would only shine through.
            apart = np.linalg.norm(self._data.xpos - measured, axis=1)
            wanted = bool(np.max(apart) > GHOST_INSET)
        if wanted and not self._ghost:
            self._ghost = self._add_bodies("ghost", GHOST_COLOUR, GHOST_OPACITY)
        if wanted:
            self._place(self._ghost)
        for body in self._ghost.values():
            if body.visible != wanted:
                body.visible = wanted
        self._pose(self._q, self._phi)
        self._place(self._bodies)
        self._show_arrow(u if np.isfinite(u) else 0.0)

    def look_from(self, client: "viser.ClientHandle", name: str) -> None:
        """Turn the camera of a browser; in a narrow window it stands further away.

        Args:
            client: The browser.
            name: One of `VIEWS`.
        """
        (position, target), camera = self._views[name], client.camera
        aspect = float(camera.aspect)
        position = target + max(1.0, 1.0 / max(aspect, 0.2)) * (position - target)
        self._looks[client.client_id] = name, aspect, position
        with client.atomic():
            camera.fov = float(np.radians(FOV_DEG))
            camera.up_direction = 0.0, 0.0, 1.0
            camera.position = position
            camera.look_at = target

    def keep_in_view(self, client: "viser.ClientHandle") -> None:
        """Look from the same view after a change of the window's shape, unless it was turned.

        A browser that is new to this rig looks as in figure 3.
        """
        if client.client_id not in self._looks:
            self.look_from(client, FIGURE_3)
        name, aspect, position = self._looks[client.client_id]
        turned = np.linalg.norm(client.camera.position - position) > TURNED
        if not turned and abs(float(client.camera.aspect) - aspect) > 1e-3:
            self.look_from(client, name)

    def remove(self) -> None:
        """Remove the rig from the scene."""
        self._root.remove()

    def _pose(self, q: Floats, phi: float) -> None:
        self._data.qpos[:] = [*q, phi]
        mujoco().mj_kinematics(self._model, self._data)

    def _place(self, bodies: dict[int, Any]) -> None:
        """Move the bodies to the poses of MuJoCo, if these have changed."""
        for number, frame in bodies.items():
            position, wxyz = self._data.xpos[number], self._data.xquat[number]
            now = np.concatenate([position, wxyz])
            if not np.array_equal(self._shown.get(frame.name, ()), now):
                self._shown[frame.name] = now
                frame.position, frame.wxyz = position.copy(), wxyz.copy()

    def _show_arrow(self, u: float) -> None:
        start = self.pivot - np.array([0.0, 0.0, ARROW_BELOW])
        end = start + np.array([ARROW_PER_U * u, 0.0, 0.0])
        points = np.array([[start, end]], np.float32)
        if self._arrow is None:
            if u:
                colour: Any = _rgb(ARROW)
                size: Any = {"shaft_radius": 0.008, "head_radius": 0.018, "head_length": 0.03}
                self._arrow = self._scene.add_arrows(f"{self._name}/u", points, colour, **size)
            return
        if self._arrow.visible != bool(u):
            self._arrow.visible = bool(u)
        if u:
            self._arrow.points = points

    def _plane(self) -> int:
        kind = int(mujoco().mjtGeom.mjGEOM_PLANE)
        return int(np.flatnonzero(self._model.geom_type == kind)[0])

    def _add_bodies(
        self, name: str, colour: tuple[int, ...], opacity: float | None
    ) -> dict[int, Any]:
        """Add a frame with meshes for each body; a ghost has the moving ones in one colour."""
        import trimesh

        parts: dict[int, dict[tuple[int, ...], list[Any]]] = defaultdict(lambda: defaultdict(list))
        for number in range(self._model.ngeom):
            body = int(self._model.geom_bodyid[number])
            if number == self._plane() or (opacity is not None and body == 0):
                continue
            own = colour or _rgb(self._model.mat_rgba[self._model.geom_matid[number]])
            parts[body][own].append(self._mesh(number, 0.0 if opacity is None else GHOST_INSET))
        frames: dict[int, Any] = {}
        for body, colours in parts.items():
            base = f"{self._name}/{name} {body}"
            frames[body] = self._scene.add_frame(base, show_axes=False)
            for number, (own, meshes) in enumerate(colours.items()):
                mesh: Any = trimesh.util.concatenate(meshes)
                rgb: Any = own
                added = self._scene.add_mesh_simple(
                    f"{base}/{number}",
                    *(mesh.vertices, mesh.faces),
                    color=rgb,
                    opacity=opacity,
                    cast_shadow=opacity is None,
                    receive_shadow=opacity is None,
                )
                if opacity is None and body == self._model.body("pendulum").id:
                    self.pendulum.append(added)
        return frames

    def _mesh(self, number: int, inset: float) -> Any:
        """Return the shape of a geom in the frame of its body, its radius smaller by `inset`."""
        from trimesh import creation

        model, kinds = self._model, mujoco().mjtGeom
        radius, half = (float(size) for size in model.geom_size[number][:2])
        radius = max(radius - inset, 0.5 * radius)
        kind = int(model.geom_type[number])
        if kind == int(kinds.mjGEOM_BOX):
            mesh: Any = creation.box(2.0 * model.geom_size[number])
        elif kind == int(kinds.mjGEOM_CYLINDER):
            mesh = creation.cylinder(radius, 2.0 * half, sections=SECTIONS)
        else:
            mesh = creation.capsule(2.0 * half, radius, count=(SECTIONS, SECTIONS))
            mesh.apply_translation(-mesh.bounds.mean(axis=0))
        rotation, pose = np.zeros(9), np.eye(4)
        mujoco().mju_quat2Mat(rotation, model.geom_quat[number])
        pose[:3, :3], pose[:3, 3] = rotation.reshape(3, 3), model.geom_pos[number]
        mesh.apply_transform(pose)
        return mesh


def _views(camera: Camera, pivot: Floats) -> dict[str, tuple[Floats, Floats]]:
    """Return position and target of the camera for each view [m]."""
    ahead = np.cross(camera.up, camera.right)
    depth = float(ahead @ (pivot - camera.position))
    target = camera.position + depth * ahead
    distance = (1.0 + FURTHER) * depth
    return {
        FIGURE_3: (target - distance * ahead, target),
        FRONT: (pivot + np.array([0.0, distance, 0.0]), pivot),
        TOP: (pivot + distance * np.array([0.0, -0.02, 1.0]), pivot),  # up stays defined
    }


def _rgb(colour: Any) -> tuple[int, ...]:
    """Return red, green and blue from 0 to 255, of a colour with parts from 0 to 1."""
    return tuple(round(255 * float(part)) for part in colour[:3])
