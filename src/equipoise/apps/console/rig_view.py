"""Arm and pendulum in 3-D in the browser, from joint angles and phi.

The geometry is that of the films (`equipoise.film.build_scene`). Each body of the MuJoCo model
becomes one mesh per colour; MuJoCo computes the poses of the bodies. Coordinates are those of the
base frame [m], z upwards.
"""

from collections import defaultdict
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from equipoise.film import ARROW, ARROW_BELOW, ARROW_PER_U, FOV_DEG, build_scene, camera_axes
from equipoise.model.arms.arm import Arm
from equipoise.model.physics_engine import mujoco
from equipoise.paper import X_LIMIT

if TYPE_CHECKING:
    import viser

Floats = npt.NDArray[np.float64]

NAME: Final = "/rig"
"""Name of the rig in the tree of the scene."""
GHOST_OPACITY: Final = 0.35
"""Opacity of the ghost [-]."""
GHOST_INSET: Final = 0.003
"""Distance of the ghost's surface below the arm's [m]: the arm hides a ghost in its posture."""


class RigView:
    """A rig in a viser scene: arm, pendulum, table, and the ends of the track.

    A pose takes one message per moving body. Use `server.atomic()` around several calls that belong
    to one picture.
    """

    def __init__(self, server: "viser.ViserServer", arm: Arm) -> None:
        """Add a rig at home with a hanging pendulum, and set the camera of new browsers.

        Args:
            server: The viser server.
            arm: The arm.
        """
        self._rig, self._scene = build_scene(arm), server.scene
        self._data = mujoco().MjData(self._rig.model)
        self._root = server.scene.add_frame(NAME, show_axes=False)
        self._bodies = self._add_bodies("real", ghost=False)
        self._ghost: dict[int, Any] = {}
        self._seen: dict[int, tuple[float, Floats]] = {}
        colour: Any = tuple(round(255 * part) for part in ARROW[:3])
        size: Any = {"shaft_radius": 0.008, "head_radius": 0.018, "head_length": 0.03}
        nowhere = np.zeros((1, 2, 3), np.float32)
        self._arrow = server.scene.add_arrows(f"{NAME}/u", nowhere, colour, visible=False, **size)
        for x, top in zip((-X_LIMIT, X_LIMIT), self._rig.posts, strict=True):
            place = top + np.array([0.0, 0.0, 0.04])
            server.scene.add_label(f"{NAME}/post {x:+g}", f"{x:+g} m", position=place)
        self.q, self.phi = np.array(arm.home), np.pi
        if not server.get_clients():  # it would move the cameras of those, after `keep_in_view`
            view = server.initial_camera
            view.fov, view.look_at = float(np.radians(FOV_DEG)), self._rig.target
            view.position = self._camera_position(1.0)
        self.show(self.q, self.phi)

    @property
    def pivot(self) -> Floats:
        """Position of the pendulum's pivot in the posture shown last [m], shape (3,)."""
        return np.array(self._data.body("pendulum").xpos)

    @property
    def x(self) -> float:
        """Displacement of the pivot from home along x in the posture shown last [m]."""
        return float(self.pivot[0] - self._rig.pivot[0])

    @property
    def pendulum(self) -> list[Any]:
        """Meshes of the pendulum, which a mouse may drag."""
        return self._bodies[self._rig.model.body("pendulum").id][1]

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
        self.q = np.array(q, np.float64) if np.all(np.isfinite(q)) else self.q
        self.phi = float(phi) if np.isfinite(phi) else self.phi
        places = self._pose(self.q)
        apart = False
        if commanded is not None and np.all(np.isfinite(commanded)):
            moved = np.linalg.norm(self._pose(np.array(commanded, np.float64)) - places, axis=1)
            apart = bool(np.max(moved) > GHOST_INSET)
        if apart:
            self._ghost = self._ghost or self._add_bodies("ghost", ghost=True)
            self._place(self._ghost)
        for frame, _ in self._ghost.values():
            _set(frame, "visible", apart)
        self._pose(self.q)
        self._place(self._bodies)
        pushing = bool(np.isfinite(u) and u)
        _set(self._arrow, "visible", pushing)
        if pushing:
            start = self.pivot - np.array([0.0, 0.0, ARROW_BELOW])
            end = start + np.array([ARROW_PER_U * u, 0.0, 0.0])
            self._arrow.points = np.array([[start, end]], np.float32)

    def keep_in_view(self, client: "viser.ClientHandle") -> None:
        """Show the whole rig after a change of a window's shape, unless its user turned the view.

        A browser that is new to this rig looks as in the films.
        """
        camera, aspect = client.camera, float(client.camera.aspect)
        seen = self._seen.get(client.client_id)
        if seen is not None:
            turned = np.linalg.norm(camera.position - seen[1]) > 0.01
            if turned or abs(aspect - seen[0]) < 1e-3:
                return
        position = self._camera_position(aspect)
        self._seen[client.client_id] = aspect, position
        with client.atomic():
            camera.fov = float(np.radians(FOV_DEG))
            camera.up_direction = 0.0, 0.0, 1.0
            camera.position, camera.look_at = position, self._rig.target

    def remove(self) -> None:
        """Remove the rig from the scene."""
        self._root.remove()

    def _camera_position(self, aspect: float) -> Floats:
        distance = self._rig.distance(min(max(aspect, 0.2), 1.0))
        return self._rig.target - distance * camera_axes()[2]

    def _pose(self, q: Floats) -> Floats:
        """Compute the poses of the bodies, and return their positions [m], shape (bodies, 3)."""
        self._data.qpos[:] = [*q, self.phi]
        mujoco().mj_kinematics(self._rig.model, self._data)
        return np.array(self._data.xpos)

    def _place(self, bodies: dict[int, tuple[Any, list[Any]]]) -> None:
        """Move the bodies to the poses of MuJoCo, if these have changed."""
        for number, (frame, _) in bodies.items():
            position, wxyz = self._data.xpos[number], self._data.xquat[number]
            if not np.array_equal([*frame.position, *frame.wxyz], [*position, *wxyz]):
                frame.position, frame.wxyz = position.copy(), wxyz.copy()

    def _add_bodies(self, name: str, *, ghost: bool) -> dict[int, tuple[Any, list[Any]]]:
        """Add a frame with meshes for each body; a ghost has the moving ones in blue."""
        import trimesh

        model = self._rig.model
        parts: dict[int, dict[tuple[int, ...], list[Any]]] = defaultdict(lambda: defaultdict(list))
        for number in range(model.ngeom):
            body = int(model.geom_bodyid[number])
            if not ghost or body != 0:
                colour = (0, 114, 178) if ghost else _rgb(model.geom_rgba[number])
                mesh = self._mesh(number, GHOST_INSET if ghost else 0.0)
                parts[body][colour].append(mesh)
        frames: dict[int, tuple[Any, list[Any]]] = {}
        for body, colours in parts.items():
            base = f"{NAME}/{name} {body}"
            frames[body] = self._scene.add_frame(base, show_axes=False), []
            for number, (colour, meshes) in enumerate(colours.items()):
                mesh: Any = trimesh.util.concatenate(meshes)
                look: Any = {"color": colour, "opacity": GHOST_OPACITY if ghost else None}
                shadow: Any = {"cast_shadow": not ghost, "receive_shadow": not ghost}
                place = f"{base}/{number}", mesh.vertices, mesh.faces
                frames[body][1].append(self._scene.add_mesh_simple(*place, **look, **shadow))
        return frames

    def _mesh(self, number: int, inset: float) -> Any:
        """Return the shape of a geom in the frame of its body, its radius smaller by `inset`."""
        from trimesh import creation

        model, kinds = self._rig.model, mujoco().mjtGeom
        radius, half = (float(size) for size in model.geom_size[number][:2])
        radius = max(radius - inset, 0.5 * radius)
        kind = int(model.geom_type[number])
        if kind == int(kinds.mjGEOM_CYLINDER):
            mesh: Any = creation.cylinder(radius, 2.0 * half, sections=24)
        elif kind == int(kinds.mjGEOM_CAPSULE):
            mesh = creation.capsule(2.0 * half, radius, count=(24, 24))
            mesh.apply_translation(-mesh.bounds.mean(axis=0))
        else:  # a box, or the floor
            flat = kind == int(kinds.mjGEOM_PLANE)
            mesh = creation.box(2.0 * model.geom_size[number] * [1.0, 1.0, 1e-3 if flat else 1.0])
        rotation, pose = np.zeros(9), np.eye(4)
        mujoco().mju_quat2Mat(rotation, model.geom_quat[number])
        pose[:3, :3], pose[:3, 3] = rotation.reshape(3, 3), model.geom_pos[number]
        mesh.apply_transform(pose)
        return mesh


def _set(handle: Any, name: str, value: Any) -> None:
    """Set a property, which is sent to the browsers, unless it is equal already."""
    if getattr(handle, name) != value:
        setattr(handle, name, value)


def _rgb(colour: Any) -> tuple[int, ...]:
    """Return red, green and blue from 0 to 255, of a colour with parts from 0 to 1."""
    return tuple(round(255 * float(part)) for part in colour[:3])
