"""Page of the playground: the twin in real time, a mouse to push it, switches to change it."""

import threading
import time
from collections.abc import Callable
from math import degrees, pi, radians, remainder
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from equipoise.apps.console.gauges import note
from equipoise.apps.console.panel import RigPanel
from equipoise.apps.console.playground import Frame, Playground, Training
from equipoise.apps.console.scenes import SCENES, PolicyChoice, Scene
from equipoise.apps.console.web import LOOPBACK, serving
from equipoise.apps.style import GREEN, INK, VERMILION
from equipoise.control.policy import TaskPolicy
from equipoise.paper import U_MAX
from equipoise.settings import BoxSettings

if TYPE_CHECKING:
    import viser

PICTURE: Final = 4
"""Number of ticks between two pictures."""
SLOW: Final = 12
"""Number of pictures between two texts, and two pictures of the boxes."""
PUSH_DEG: Final = 15.0
"""Change of the pendulum's rate by a button [deg/s]."""
FLICK: Final = radians(120.0)
"""Change of the rate per distance of the mouse in the scene [rad/s per m]."""
HARDEST: Final = radians(60.0)
"""Largest change of the rate by the mouse [rad/s]."""
LATE: Final = 0.2
"""Delay behind real time above which the playground goes on later instead of faster [s]."""
CELL: Final = 14
"""Width of a box of the table [px]."""
POLICIES: Final[dict[PolicyChoice, str]] = {
    "robust": "the shipped table",
    "paper": "the paper's table",
    "lqr": "LQR, no table",
    "trained": "just trained",
    "yours": "yours",
}
"""Labels of the policies."""
RECIPES: Final[dict[PolicyChoice, str]] = {"paper": "paper", "trained": "robust"}
"""Recipes of the policies that are trained here."""

Pixels = npt.NDArray[np.uint8]


class PlayPage:
    """Content of all browsers: they share one pendulum."""

    def __init__(
        self, server: "viser.ViserServer", scene: Scene, yours: TaskPolicy | None = None
    ) -> None:
        """Fill a server's page.

        Args:
            server: The viser server.
            scene: The first scene.
            yours: The policy of `--policy`.
        """
        self._lock, self._server, self._scene = threading.RLock(), server, scene
        self._training: Training | None = None
        self._trained_as: PolicyChoice = "trained"
        trained_here = scene.policy in RECIPES
        ready = scene._replace(policy="robust") if trained_here else scene
        self.playground = Playground(ready, yours)
        """The twin behind the page."""
        self._note = ""
        self._panel = RigPanel(server, "Equipoise playground", self.playground.arm)
        self._add_controls(server.gui, scene)
        if self._panel.view is not None:
            for mesh in self._panel.view.pendulum:
                mesh.on_drag("left")(self._dragged)
        if trained_here:
            self._train(scene.policy)

    def _add_controls(self, gui: Any, scene: Scene) -> None:
        pushes = gui.add_button_group("Push", ("◀ push left", "push right ▶"), order=10)
        pushes.on_click(
            lambda event: self._push(
                radians(-PUSH_DEG if "left" in event.target.value else PUSH_DEG)
            )
        )
        gui.add_button("Release again", order=11).on_click(lambda _: self._set(self._scene))
        with gui.add_folder("The rig", order=50):
            chosen = next((name for name, each in SCENES.items() if each == scene), "balance")
            scenes = gui.add_dropdown("scene", tuple(SCENES), initial_value=chosen)
            scenes.on_update(lambda _: self._take(SCENES[scenes.value]))
            labels = [
                POLICIES[n] for n in POLICIES if n != "yours" or n in self.playground.policies
            ]
            policy = gui.add_dropdown("policy", labels, initial_value=POLICIES[scene.policy])
            self._controls: dict[str, tuple[Any, float]] = {
                "policy": (policy, 0.0),
                "predict": (gui.add_checkbox("prediction", scene.predict), 0.0),
            }
            for name, label, low, high, step, unit in (
                ("delay", "delay [ms]", 0.0, 60.0, 1.0, 1e-3),
                ("zero", "zero error [deg]", -3.0, 3.0, 0.1, radians(1.0)),
                ("friction", "friction [1/s²]", 0.0, 2.0, 0.05, 1.0),
                ("lean", "start [deg]", -10.0, 10.0, 0.5, radians(1.0)),
            ):
                value = round(getattr(scene, name) / unit, 3)
                ends: Any = {"min": low, "max": high, "step": step, "initial_value": value}
                self._controls[name] = gui.add_slider(label, **ends), unit
        for control, _ in self._controls.values():
            control.on_update(
                lambda event: self._changed() if event.client_id is not None else None
            )
        with gui.add_folder("The table: 270 boxes", order=51):
            self._boxes = gui.add_image(self._picture(-1), format="png")
            self._boxes_note = gui.add_html("")
        with gui.add_folder("Train a table", order=52):
            self._button = gui.add_button("Train")
            self._button.on_click(lambda _: self._train("trained"))
            self._trained = gui.add_html("")
            self._curve = gui.add_uplot(
                (np.array([0.0, 1.0]), np.zeros(2)),
                ({}, {"stroke": GREEN, "width": 2, "points": {"show": False}}),
                title="mean duration of the episodes [s] over their number",
                scales={"x": {"time": False}},
                axes=({"size": 24, "stroke": INK}, {"size": 44, "stroke": INK}),
                legend={"show": False},
                height=150,
                visible=False,
            )

    def _changed(self) -> None:
        """Set the scene of the controls up."""
        values: dict[str, Any] = {
            name: unit * control.value if unit else control.value
            for name, (control, unit) in self._controls.items()
        }
        labels = {label: name for name, label in POLICIES.items()}
        values["policy"] = labels[values["policy"]]
        with self._lock:
            self._set(self._scene._replace(**values))

    def _take(self, scene: Scene) -> None:
        """Set a scene up, and move the controls there."""
        with self._lock:
            for name, (control, unit) in self._controls.items():
                value = getattr(scene, name)
                control.value = round(value / unit, 3) if unit else POLICIES.get(value, value)
            self._set(scene)

    def _set(self, scene: Scene) -> None:
        with self._lock:
            self._scene, self._note = scene, ""
            ready = scene.policy in self.playground.policies
            used = scene.policy if ready else self.playground.scene.policy
            self.playground.set(scene._replace(policy=used))
            if not ready and scene.policy in RECIPES:
                self._train(scene.policy)

    def _train(self, choice: PolicyChoice) -> None:
        """Begin the training of a policy, which is chosen at its end."""
        with self._lock:
            if self._training is None:
                random = int.from_bytes(np.random.default_rng().bytes(4))
                seed = random if choice == "trained" else 0
                self._trained_as, self._training = choice, Training(RECIPES[choice], seed)
                self._note = f"{POLICIES[choice].capitalize()} is being trained; see below."
                self._button.disabled = self._curve.visible = True

    def _dragged(self, event: Any) -> None:
        """Push the pendulum when the mouse lets it go, as far as it was drawn along the track."""
        if event.phase == "end":
            drawn = event.end_position[0] - event.start_position[0]
            self._push(float(np.clip(FLICK * drawn, -HARDEST, HARDEST)))

    def _push(self, rate: float) -> None:
        with self._lock:
            self.playground.push(rate)
            side = "right" if rate > 0.0 else "left"
            self._note = f"Pushed to the {side} by {abs(degrees(rate)):.0f} °/s."

    def advance(self, picture: int) -> None:
        """Advance by one picture.

        Args:
            picture: Number of the picture.
        """
        with self._lock, self._server.atomic():
            frame = self.playground.advance()
            for _ in range(PICTURE - 1):
                frame = self.playground.advance()
            phi = remainder(frame.phi, 2.0 * pi)
            self._panel.show(frame.q, phi, x=frame.x, commanded=frame.commanded, u=frame.u)
            if picture % SLOW == 0:
                self._describe(frame)
                self._follow_training()

    def _describe(self, frame: Frame) -> None:
        playground = self.playground
        name, colour = ("fallen", VERMILION) if frame.fallen else ("standing", GREEN)
        sentences = playground.sentences(frame)
        self._panel.say(name, colour, [self._note, self._scene.about, *sentences])
        self._boxes.image = self._picture(frame.box)
        text = "This policy has no table: it computes its command from the state itself."
        if playground.u_of_box is not None:
            text = (
                "Each cell is a box: angle to the right, its rate upwards; the nine groups are "
                "place and speed of the flange. Orange pushes right, blue left. Bright boxes were "
                "used just now, the black one is in use."
            )
        if self._boxes_note.content != note(text):
            self._boxes_note.content = note(text)

    def _follow_training(self) -> None:
        training = self._training
        if training is None:
            return
        points = list(training.points)
        if len(points) > 1:
            episodes = np.array([point.episodes for point in points], np.float64)
            self._curve.data = (episodes, np.array([point.duration for point in points]))
        running = training.running
        self._trained.content = note(training.sentence(), "training")
        if not running:
            self._training, self._button.disabled = None, False
            if training.policy is not None:
                self.playground.policies[self._trained_as] = training.policy
                self._take(self._scene._replace(policy=self._trained_as))

    def _picture(self, current: int) -> Pixels:
        """Return the boxes as a picture, shape (height, width, 3)."""
        shape, gap = BoxSettings().shape, 8
        n_phi, n_rate, n_x, n_speed = shape
        wide, high = n_phi * CELL + gap, n_rate * CELL + gap
        picture = np.full((n_speed * high + gap, n_x * wide + gap, 3), 255, np.uint8)
        pushes, used = self.playground.u_of_box, self.playground.used
        for box, place in enumerate(np.ndindex(*shape)):
            phi, rate, x, speed = place
            left = gap + x * wide + phi * CELL
            top = gap + (n_speed - 1 - speed) * high + (n_rate - 1 - rate) * CELL
            full, ink = np.zeros(3), 0.06
            if pushes is not None:
                full = np.array((213, 94, 0) if pushes[box] > 0.0 else (0, 114, 178), np.float64)
                ink = abs(float(pushes[box])) / U_MAX * (0.15 + 0.85 * float(used[box]))
            cell = picture[top : top + CELL - 1, left : left + CELL - 1]
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
        InputError: The address is invalid.
        OutsideError: The port is not available.
    """
    with serving(address, port) as (server, url):
        page = PlayPage(server, scene, yours)
        ready(url)
        run(page, stopped)


def run(page: PlayPage, stopped: Callable[[], bool]) -> None:
    """Advance a page in real time until stopped."""
    due, picture = time.monotonic(), 0
    while not stopped():
        page.advance(picture)
        picture += 1
        due += PICTURE * page.playground.h
        now = time.monotonic()
        if now - due > LATE:
            due = now
        time.sleep(max(due - now, 0.0))
