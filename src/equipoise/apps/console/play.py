"""Page of the playground: the twin in real time, a mouse to push it, switches to change it."""

import threading
import time
from collections.abc import Callable
from itertools import pairwise
from math import inf, pi, radians, remainder
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from equipoise.apps.console.playground import SCENES, Playground, Scene
from equipoise.apps.console.scene import RigPage, card
from equipoise.apps.console.web import LOOPBACK, serving
from equipoise.apps.style import BLUE, GREEN, GREY, INK, PALE, VERMILION, edges
from equipoise.control.policy import TaskPolicy
from equipoise.paper import PHI_LIMIT_DEG, U_MAX, X_LIMIT
from equipoise.settings import BoxSettings

if TYPE_CHECKING:
    import viser

PICTURE: Final = 4
"""Number of ticks between two pictures."""
SLOW: Final = 12
"""Number of pictures between two texts, and two drawings of the table."""
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
            self._boxes = gui.add_html(self._drawn_table())

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
                self._boxes.content = self._drawn_table()

    def _drawn_table(self) -> str:
        """Return the boxes with their axes as SVG, and a legend."""
        twin, boxes, cell, gap = self.playground, BoxSettings(), 15, 16  # [px]
        pushes = np.zeros(boxes.count) if twin.u_of_box is None else twin.u_of_box
        n_phi, n_rate, n_x, n_speed = boxes.shape
        wide, high = n_phi * cell + gap, n_rate * cell + gap
        width, height = n_x * wide, n_speed * high
        parts: list[str] = []
        for box, (phi, rate, x, speed) in enumerate(np.ndindex(*boxes.shape)):
            left = x * wide + phi * cell
            top = (n_speed - 1 - speed) * high + (n_rate - 1 - rate) * cell
            u = pushes[box]
            ink = abs(u) / U_MAX * (0.15 + 0.85 * twin.used[box])
            pen = f'stroke="{INK}" stroke-width="3"' if box == twin.box else f'stroke="{PALE}"'
            parts.append(
                f'<rect x="{left}" y="{top}" width="{cell - 2}" height="{cell - 2}" {pen} '
                f'fill="{VERMILION if u > 0.0 else BLUE}" fill-opacity="{ink:.2f}"/>'
            )

        def write(x: float, y: float, text: str, turned: int = 0) -> None:
            place = f'transform="translate({x:g} {y:g}) rotate({turned})"'
            parts.append(f'<text {place} text-anchor="middle">{text}</text>')

        angles, rates = edges(boxes.phi_deg, PHI_LIMIT_DEG), edges(boxes.phi_dot_deg, inf)
        for n, (low, high_end) in enumerate(pairwise(edges(boxes.x, X_LIMIT))):
            write(n * wide + 0.5 * (wide - gap), -6, f"x {low} to {high_end} m")
            for edge in range(1, n_phi, 2):
                write(n * wide + edge * cell, height + 2, angles[edge])
        for n, (low, high_end) in enumerate(pairwise(edges(boxes.x_dot, inf))):
            top = (n_speed - 1 - n) * high
            write(width - 4, top + 0.5 * (high - gap), f"ẋ {low} to {high_end} m/s", 90)
            for edge in range(1, n_rate):
                write(-12, top + (n_rate - edge) * cell + 3, rates[edge])
        write(0.5 * width, height + 16, "angle φ [°]")
        write(-28, 0.5 * height, "its rate dφ/dt [°/s]", -90)
        return card(
            "table",
            f'<svg viewBox="-40 -18 {width + 46} {height + 40}" width="100%" font-size="9.5" '
            f'fill="{INK}">{"".join(parts)}</svg><b style="color:{VERMILION}">■</b> pushes right, '
            f'<b style="color:{BLUE}">■</b> left; a strong colour is a strong push. Bright boxes '
            "were used just now; the framed one is in use.",
        )


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
