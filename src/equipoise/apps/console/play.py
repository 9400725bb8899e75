"""Page of the playground: the twin in real time, a mouse to push it, switches to change it."""

import threading
import time
from collections.abc import Callable
from math import degrees, radians
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from equipoise.apps.console.gauges import gauges, shown, state_card
from equipoise.apps.console.playground import Frame, Playground, Training
from equipoise.apps.console.scene import RigView
from equipoise.apps.console.scenes import SCENES, PolicyChoice, Scene, check_lean
from equipoise.apps.console.web import LOOPBACK, serving
from equipoise.apps.report.style import GREEN, GREY, INK, VERMILION
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
GAP: Final = 8
"""Distance between groups of boxes [px]."""
HANG_DEG: Final = 180.0
"""Angle of a hanging pendulum from upright [deg]."""
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
        self._lock, self._server = threading.RLock(), server
        self._wanted, self._training = scene, None
        self._used_for: PolicyChoice = "trained"
        ready = scene if scene.policy in ("robust", "lqr", "yours") else _with(scene, "robust")
        self.playground = Playground(ready, yours=yours)
        """The twin behind the page."""
        self._note, self._plotted = "", 0
        self._view = RigView(server, self.playground.arm)
        server.scene.configure_environment_map("studio", environment_intensity=0.5)
        self._add_controls(server, scene, yours is not None)
        for mesh in self._view.pendulum:
            mesh.on_drag("left")(self._dragged)
        server.on_client_connect(self._connect)
        if scene.policy in RECIPES:
            self._train(scene.policy)

    def _connect(self, client: "viser.ClientHandle") -> None:
        self._view.keep_in_view(client)
        client.camera.on_update(lambda _: self._view.keep_in_view(client))

    def _add_controls(self, server: "viser.ViserServer", scene: Scene, has_yours: bool) -> None:
        gui = server.gui
        gui.configure_theme(show_logo=False, show_share_button=False)
        gui.set_panel_label("Equipoise playground")
        gui.main_panel.dock_right()
        gui.main_panel.set_width(400.0)
        self._state = gui.add_html("")
        pushes = gui.add_button_group("Push", ("◀ push left", "push right ▶"))
        pushes.on_click(lambda event: self._push_by(event.target.value))
        gui.add_button("Release again").on_click(lambda _: self._again())
        self._gauges = gui.add_html(gauges(0.0, 0.0))
        with gui.add_folder("The rig"):
            chosen = next((name for name, each in SCENES.items() if each == scene), "balance")
            self._scenes = gui.add_dropdown("scene", tuple(SCENES), initial_value=chosen)
            names = [POLICIES[name] for name in POLICIES if name != "yours" or has_yours]
            self._policy = gui.add_dropdown(
                "policy", tuple(names), initial_value=POLICIES[scene.policy]
            )
            self._predict = gui.add_checkbox("prediction", scene.predict)
            self._delay = _slider(gui, "delay [ms]", 0.0, 60.0, 1.0, 1e3 * scene.delay)
            self._zero = _slider(gui, "zero error [deg]", -3.0, 3.0, 0.1, degrees(scene.zero))
            self._friction = _slider(gui, "friction [1/s²]", 0.0, 2.0, 0.05, scene.friction)
            self._lean = _slider(gui, "start [deg]", -10.0, 10.0, 0.5, degrees(scene.lean))
            gui.add_button("Start from hanging").on_click(lambda _: self._start_at(HANG_DEG))
            save = gui.add_button("Save this scene")
            save.on_click(self._save)
        with gui.add_folder("The table: 270 boxes"):
            self._boxes = gui.add_image(self._picture(-1), format="png")
            self._boxes_note = gui.add_html("")
        with gui.add_folder("Train a table"):
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
        self._scenes.on_update(lambda _: self._take(SCENES[self._scenes.value]))
        controls = (
            self._policy,
            self._predict,
            self._delay,
            self._zero,
            self._friction,
            self._lean,
        )
        for control in controls:
            control.on_update(lambda _: self._changed())

    # What a browser does.

    def _changed(self) -> None:
        """Set the scene of the controls up."""
        policy = next(name for name, label in POLICIES.items() if label == self._policy.value)
        values = {
            "policy": policy,
            "predict": bool(self._predict.value),
            "delay": 1e-3 * float(self._delay.value),
            "zero": radians(float(self._zero.value)),
            "friction": float(self._friction.value),
            "lean": radians(float(self._lean.value)),
        }
        with self._lock:
            wanted = self._wanted.model_copy(update=values)
            if wanted != self._wanted:
                self._set(wanted)

    def _take(self, scene: Scene) -> None:
        """Set a scene up, and move the controls there."""
        with self._lock:
            self._wanted = scene
            self._policy.value = POLICIES[scene.policy]
            self._predict.value = scene.predict
            self._delay.value = 1e3 * scene.delay
            self._zero.value = degrees(scene.zero)
            self._friction.value = scene.friction
            self._lean.value = degrees(scene.lean)
            self._set(scene)

    def _set(self, scene: Scene) -> None:
        self._wanted = scene
        if scene.policy in self.playground.policies:
            self._note = ""
            self.playground.set(scene)
        elif scene.policy in RECIPES:
            self.playground.set(_with(scene, self.playground.scene.policy))
            self._train(scene.policy)

    def _train(self, choice: PolicyChoice) -> None:
        """Begin the training of a policy, which is chosen at its end."""
        with self._lock:
            if self._training is not None and self._training.running:
                return
            seed = int.from_bytes(np.random.default_rng().bytes(4)) if choice == "trained" else 0
            self._used_for, self._plotted = choice, 0
            self._training = Training(RECIPES[choice], seed)
            self._note = f"{POLICIES[choice].capitalize()} is being trained; see below."
            self._button.disabled = True
            self._curve.visible = True

    def _push_by(self, label: str) -> None:
        self._push(radians(-PUSH_DEG if "left" in label else PUSH_DEG))

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

    def _again(self) -> None:
        with self._lock:
            self._note = ""
            self.playground.begin()

    def _start_at(self, lean_deg: float) -> None:
        with self._lock:
            self._note = check_lean(lean_deg)

    def _save(self, event: Any) -> None:
        if event.client is not None:
            event.client.send_file_download("scene.toml", self._wanted.text().encode())

    # What everyone sees.

    def advance(self, picture: int) -> None:
        """Advance by one picture.

        Args:
            picture: Number of the picture.
        """
        with self._lock, self._server.atomic():
            frame = self.playground.advance()
            for _ in range(PICTURE - 1):
                frame = self.playground.advance()
            self._view.show(frame.q, frame.phi, commanded=frame.commanded, u=frame.u)
            self._gauges.content = gauges(
                float(np.remainder(frame.phi + np.pi, 2 * np.pi) - np.pi), frame.x
            )
            if picture % SLOW == 0:
                self._describe(frame)
                self._follow_training()

    def _describe(self, frame: Frame) -> None:
        playground = self.playground
        name, colour = ("fallen", VERMILION) if frame.fallen else ("standing", GREEN)
        about = playground.scene.about
        lines = [*([about] if about else []), *playground.sentences(frame)]
        card = state_card(name, colour, [*([self._note] if self._note else []), *lines])
        if card != self._state.content:
            self._state.content = card
        self._boxes.image = self._picture(frame.box)
        text = (
            "Each cell is a box: angle to the right, its rate upwards; the nine groups are place "
            "and speed of the flange. Orange pushes right, blue left. Bright boxes were used just "
            "now, the black one is in use."
            if playground.has_table
            else "This policy has no table: it computes its command from the state itself."
        )
        content = f'<div style="font:13px system-ui;color:{GREY};padding:0 12px">{text}</div>'
        if self._boxes_note.content != content:
            self._boxes_note.content = content

    def _follow_training(self) -> None:
        training = self._training
        if training is None:
            return
        if len(training.points) > max(self._plotted, 1):
            points = list(training.points)
            self._plotted = len(points)
            episodes = np.array([point.episodes for point in points], np.float64)
            self._curve.data = (episodes, np.array([point.duration for point in points]))
        total = training.settings.learning.episodes
        done = training.points[-1].episodes if training.points else 0
        if training.running:
            what = f"{done:,} of {total:,} episodes"
            what += "; now the best of its tables is selected." if done >= total else "."
            what = what if done else "Beginning; the first time the code is compiled, for a minute."
        elif training.policy is None:
            what = f"The training failed: {training.error}"
        else:
            policy = training.policy
            minutes = policy.steps * policy.h / 60.0
            what = f"Trained in {policy.episodes:,} episodes, {minutes:,.0f} simulated minutes."
            if policy.checkpoints:
                best = policy.checkpoints[0]
                what += (
                    f" The best of {len(policy.checkpoints)} tables from its course lasted "
                    f"{best.survived:,} of {best.trials:,} trials."
                )
        style = "font:13px system-ui,sans-serif;padding:0 12px"
        self._trained.content = f'<div id="equipoise-training" style="{style}">{shown(what)}</div>'
        if not training.running:
            self._training = None
            self._button.disabled = False
            if training.policy is not None:
                self.playground.add(self._used_for, training.policy)
                self._take(_with(self._wanted, self._used_for))

    def _picture(self, current: int) -> Pixels:
        """Return the boxes as a picture, shape (height, width, 3)."""
        shape = BoxSettings().shape
        n_phi, n_rate, n_x, n_speed = shape
        width = n_x * (n_phi * CELL + GAP) + GAP
        height = n_speed * (n_rate * CELL + GAP) + GAP
        picture = np.full((height, width, 3), 255, np.uint8)
        pushes, used = self.playground.u_of_box, self.playground.used
        for box in range(len(used)):
            phi, rate, x, speed = (int(i) for i in np.unravel_index(box, shape))
            left = GAP + x * (n_phi * CELL + GAP) + phi * CELL
            top = GAP + (n_speed - 1 - speed) * (n_rate * CELL + GAP) + (n_rate - 1 - rate) * CELL
            share = 0.0 if pushes is None else float(pushes[box]) / U_MAX
            full = np.array((213, 94, 0) if share > 0.0 else (0, 114, 178), np.float64)
            ink = abs(share) * (0.15 + 0.85 * float(used[box])) if pushes is not None else 0.06
            if pushes is None:
                full = np.zeros(3)
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


def _with(scene: Scene, policy: PolicyChoice) -> Scene:
    """Return a scene with another policy."""
    return scene.model_copy(update={"policy": policy})


def _slider(gui: Any, name: str, low: float, high: float, step: float, value: float) -> Any:
    """Add a slider; its value is rounded to the step."""
    rounded = min(max(round(value / step) * step, low), high)
    return gui.add_slider(name, min=low, max=high, step=step, initial_value=rounded)
