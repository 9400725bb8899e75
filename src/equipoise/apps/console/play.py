"""Page of the playground: the twin in real time, a mouse to push it, switches to change it."""

import threading
import time
from collections.abc import Callable
from math import pi, radians, remainder
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from equipoise.apps.console.playground import SCENES, Playground, Scene
from equipoise.apps.console.scene import RigPage
from equipoise.apps.console.web import LOOPBACK, serving
from equipoise.apps.style import GREEN, GREY, VERMILION
from equipoise.control.policy import TaskPolicy
from equipoise.paper import U_MAX
from equipoise.settings import BoxSettings

if TYPE_CHECKING:
    import viser

PICTURE: Final = 4
"""Number of ticks between two pictures."""
SLOW: Final = 12
"""Number of pictures between two texts, and two pictures of the boxes."""
PUSH: Final = radians(15.0)
"""Change of the pendulum's rate by a button [rad/s]."""
SLIDERS: Final = {
    "delay": ("transport [ms]", 0.0, 60.0, 1.0, 1e-3),
    "zero": ("zero error [deg]", -3.0, 3.0, 0.1, radians(1.0)),
    "friction": ("friction [1/s²]", 0.0, 2.0, 0.05, 1.0),
    "lean": ("start [deg]", -10.0, 10.0, 0.5, radians(1.0)),
}
"""Label, ends, step and unit of the slider for each quantity of a scene."""


class PlayPage:
    """Content of all browsers: they share one pendulum."""

    def __init__(
        self, server: "viser.ViserServer", scene: Scene, yours: TaskPolicy | None = None
    ) -> None:
        """Fill a server's page.

        Args:
            server: The viser server.
            scene: The first scene.
            yours: The policy of the user.
        """
        self._lock, self._server = threading.RLock(), server
        self._page = RigPage(server, "Equipoise playground")
        compiling = "Compiling the twin: about 20 s the first time, then 3 s."
        self._page.describe("starting", GREY, [compiling])
        self.playground = Playground(scene, yours)
        """The twin behind the page."""
        self._page.show_arm(self.playground.arm)
        self._page.pendulum.on_drag("left")(self._dragged)
        gui: Any = server.gui
        pushes = gui.add_button_group("Push", ("◀ push left", "push right ▶"), order=10)
        pushes.on_click(lambda event: self._push(-PUSH if "left" in event.target.value else PUSH))
        again = gui.add_button("Release again", order=11)
        again.on_click(lambda _: self._set(self.playground.scene))
        with gui.add_folder("The rig", order=50):
            chosen = next((name for name, each in SCENES.items() if each == scene), "balance")
            scenes = gui.add_dropdown("scene", tuple(SCENES), initial_value=chosen)
            policies = tuple(self.playground.policies)
            self._controls: dict[str, Any] = {
                "policy": gui.add_dropdown("policy", policies, initial_value=scene.policy),
                "predict": gui.add_checkbox("prediction", scene.predict),
            }
            for name, (label, low, high, step, unit) in SLIDERS.items():
                value = round(getattr(scene, name) / unit, 3)
                ends: Any = {"min": low, "max": high, "step": step, "initial_value": value}
                self._controls[name] = gui.add_slider(label, **ends)
        scenes.on_update(lambda _: self._take(SCENES[scenes.value]))
        for control in self._controls.values():
            control.on_update(
                lambda event: self._changed() if event.client_id is not None else None
            )
        self._table = gui.add_folder("The table: 270 boxes", order=51)
        with self._table:
            self._boxes = gui.add_image(self._picture(-1), format="png")
            gui.add_markdown(
                "Angle to the right, its rate upwards; the nine groups are place and speed of the "
                "flange. Orange pushes right, blue left; bright boxes were used just now."
            )

    def _changed(self) -> None:
        """Set the scene of the controls up."""
        units = {name: slider[-1] for name, slider in SLIDERS.items()}
        values: dict[str, Any] = {
            name: control.value * units[name] if name in units else control.value
            for name, control in self._controls.items()
        }
        self._set(self.playground.scene._replace(**values))

    def _take(self, scene: Scene) -> None:
        """Set a scene up, and move the controls there."""
        for name, control in self._controls.items():
            value = getattr(scene, name)
            control.value = round(value / SLIDERS[name][-1], 3) if name in SLIDERS else value
        self._set(scene)

    def _set(self, scene: Scene) -> None:
        with self._lock:
            self.playground.set(scene)

    def _dragged(self, event: Any) -> None:
        """Push the pendulum when the mouse lets it go, as far as it was drawn along the track."""
        if event.phase == "end":
            drawn = event.end_position[0] - event.start_position[0]
            # 120 deg/s for a metre of the mouse in the scene, 60 deg/s at most.
            self._push(radians(float(np.clip(120.0 * drawn, -60.0, 60.0))))

    def _push(self, rate: float) -> None:
        with self._lock:
            self.playground.push(rate)

    def advance(self, picture: int) -> None:
        """Advance by one picture.

        Args:
            picture: Number of the picture.
        """
        with self._lock, self._server.atomic():
            twin = self.playground
            for _ in range(PICTURE):
                twin.advance()
            self._page.show(twin.q, remainder(twin.phi, 2.0 * pi), twin.u)
            if picture % SLOW == 0:
                name, colour = ("fallen", VERMILION) if twin.fallen else ("standing", GREEN)
                self._page.describe(name, colour, twin.sentences())
                self._table.visible = twin.u_of_box is not None
                self._boxes.image = self._picture(twin.box)

    def _picture(self, current: int) -> npt.NDArray[np.uint8]:
        """Return the boxes as a picture, shape (height, width, 3); empty without a table."""
        shape, cell_size, gap = BoxSettings().shape, 14, 8  # [px]
        n_phi, n_rate, n_x, n_speed = shape
        wide, high = n_phi * cell_size + gap, n_rate * cell_size + gap
        picture = np.full((n_speed * high + gap, n_x * wide + gap, 3), 255, np.uint8)
        pushes, used = self.playground.u_of_box, self.playground.used
        for box, (phi, rate, x, speed) in enumerate(np.ndindex(*shape)):
            if pushes is None:
                break
            left = gap + x * wide + phi * cell_size
            top = gap + (n_speed - 1 - speed) * high + (n_rate - 1 - rate) * cell_size
            full = np.array((213, 94, 0) if pushes[box] > 0.0 else (0, 114, 178), np.float64)
            ink = abs(float(pushes[box])) / U_MAX * (0.15 + 0.85 * float(used[box]))
            cell = picture[top : top + cell_size - 1, left : left + cell_size - 1]
            if box == current:
                cell[:] = 0
                cell = cell[2:-2, 2:-2]
            cell[:] = (255.0 + ink * (full - 255.0)).astype(np.uint8)
        return picture


def play(
    scene: Scene,
    ready: Callable[[str], None],
    stopped: Callable[[], bool],
    *,
    yours: TaskPolicy | None = None,
    address: str = LOOPBACK,
    port: int = 0,
) -> None:
    """Serve the playground until stopped.

    Args:
        scene: The first scene.
        ready: Receives the address of the page with its token.
        stopped: Returns whether to end; called for each picture.
        yours: A policy to offer as `yours`.
        address: Address of this computer to listen on.
        port: Port; 0 selects a free one.

    Raises:
        MissingExtraError: viser is not installed.
        OutsideError: The address or the port is not available.
    """
    with serving(address, port) as (server, url):
        ready(url)
        page = PlayPage(server, scene, yours)
        run(page, stopped)


def run(page: PlayPage, stopped: Callable[[], bool]) -> None:
    """Advance a page in real time until stopped."""
    due, picture = time.monotonic(), 0
    while not stopped():
        page.advance(picture)
        picture += 1
        due += PICTURE * page.playground.h
        now = time.monotonic()
        if now - due > 0.2:  # [s]: go on later instead of faster
            due = now
        time.sleep(max(due - now, 0.0))
