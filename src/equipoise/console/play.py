"""The playground: the twin in real time, a mouse to push it, switches to change it.

The twin, the controller and the trials are those of an evaluation.
"""

import time
from collections.abc import Callable
from itertools import pairwise
from math import exp, inf, pi, radians, remainder, sqrt
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple

import numpy as np

from equipoise.console.scene import RigPage, card
from equipoise.control.bound_policy import load_policy
from equipoise.control.control_step import horizon
from equipoise.control.policy import Policy, TabularPolicy, TaskPolicy, shipped_policy
from equipoise.control.swing_up import SwingUpPolicy, make_swing_up, time_limit
from equipoise.files import Estimate
from equipoise.model.grid import NOT_UPRIGHT, TRUNCATED, box_indices
from equipoise.model.random import DEPLOYMENT
from equipoise.model.worlds import World, read_world
from equipoise.outcomes import TRIAL_OUTCOMES
from equipoise.paper import PHI_LIMIT, PHI_LIMIT_DEG, U_MAX, X_LIMIT
from equipoise.report.style import BLUE, GREEN, GREY, INK, PALE, VERMILION, edges
from equipoise.settings import BoxSettings, changed
from equipoise.simulation import predicted, setup_of
from equipoise.simulation.twin.world import TwinSimulation

if TYPE_CHECKING:
    import viser

FALL: Final = 2.0
"""Time that a fall is shown, in which the flange returns to the middle [s]."""
RETURN: Final = 2.5
"""Rate of this return, which is critically damped [1/s]."""
PICTURE: Final = 4
"""Number of ticks between two pictures."""
PUSH: Final = radians(15.0)
"""Change of the pendulum's rate by a button [rad/s]."""
SLIDERS: Final = {
    "delay_ms": ("transport [ms]", 0.0, 60.0, 1.0),
    "zero_deg": ("zero error [deg]", -3.0, 3.0, 0.1),
    "friction": ("friction [1/s²]", 0.0, 2.0, 0.05),
    "lean_deg": ("start [deg]", -10.0, 10.0, 0.5),
}
"""Label, ends and step of the slider for each quantity of a scene."""


class Scene(NamedTuple):
    """A scene; the defaults are the shipped policy on the nominal twin."""

    about: str = ""
    """What to look at, in a few sentences."""
    policy: Literal["shipped table", "LQR", "yours"] = "shipped table"
    """Policy that balances; `yours` is that of the user."""
    predict: bool = True
    """Whether the policy sees the state at which its command takes effect."""
    delay_ms: float = 10.0
    """Transport delay of the robot's commands, to which the servo's response adds [ms]."""
    zero_deg: float = 0.0
    """Error of the encoder's zero [deg]."""
    friction: float = 0.1
    """Dry friction of the pendulum over its inertia [1/s^2]."""
    lean_deg: float = 3.0
    """Angle from upright at the start [deg]."""


SCENES: Final = {
    "balance": Scene("Push the pendulum: how much can it take?"),
    "why-it-falls": Scene(
        "The same rig, but the policy sees the present, not the moment at which its command "
        "arrives. Lower the transport delay: from where on does it stand? Then switch the "
        "prediction on.",
        predict=False,
        delay_ms=30.0,
    ),
    "zero-error": Scene(
        "The encoder's zero is 1.5 degrees off. Watch the flange: it drives to one side until the "
        "controller has found the error.",
        zero_deg=1.5,
    ),
    "friction": Scene(
        "A sticky pivot. The pendulum rests beside upright, and the policy hunts around it.",
        friction=1.0,
    ),
    "lqr": Scene("Compare with the shipped table: which one is at rest?", policy="LQR"),
}
"""Scenes by name."""


class Playground:
    """A twin that balances tick by tick, under a scene that may change at any time.

    `advance` updates joints `q` [rad], shape (joints,), angle `phi` from upright [rad], commanded
    acceleration `u` [m/s^2], and `box`, that of the table with the policy's input, -1 for none.
    """

    def __init__(self, scene: Scene, yours: TaskPolicy | None = None) -> None:
        """Set a scene up.

        Args:
            scene: The scene.
            yours: The policy of `yours`.
        """
        self.policies = {"shipped table": shipped_policy(), "LQR": load_policy("lqr")}
        """Policies by name."""
        if yours is not None:
            self.policies["yours"] = yours
        self._number = 0
        self.set(scene)

    def set(self, scene: Scene) -> None:
        """Set another scene up, and begin again."""
        policy, base = self.policies[scene.policy], read_world("twin:nominal").settings
        transport, zero = 1e-3 * scene.delay_ms, radians(scene.zero_deg)
        rig = {"transport": transport, "coulomb": scene.friction, "zero_offset": zero}
        exact = {"zero_error": 0.0, "inertia_sigma": 0.0, "friction_sigma": 0.0}
        known = shipped_policy().actuator  # identified on the nominal twin, then moved along
        moved = max(known.delay.value + transport - base.transport, 0.0)
        actuator = known.model_copy(update={"delay": Estimate.around(moved, 0.0, "given")})
        settings = changed(policy.settings, {"controller.predict": scene.predict})
        twin = World("playground", base.model_copy(update=rig | exact))
        setup = setup_of(policy, twin, settings, actuator)
        self.scene, self.policy = scene, policy
        parameters, self.h = policy.pendulum.parameters(), policy.h
        self.latency = horizon(policy.arm, actuator, 0.0)
        """Time from a command to its effect [s]: transport, then the response of the servo."""
        self.growth = exp(sqrt(parameters.w2) * self.latency)
        """Factor by which a lean grows within the latency [-]."""
        self._simulation = TwinSimulation(twin, setup, seed=0, stream=DEPLOYMENT)
        self.loop = self._simulation.loop()
        """The closed loop; it counts as balancing unless the pendulum has fallen or swings up."""
        self.swing_up = None
        """The policy after a swing-up; None if no swing-up can end with it."""
        if policy.kernel is not None:
            law = make_swing_up(self.loop.params, self._simulation.max_speed)
            self.swing_up = SwingUpPolicy(policy.kernel, law)
        self.u_of_box = None
        if isinstance(policy, TabularPolicy) and policy.settings.boxes == BoxSettings():
            self.u_of_box, self._grid = policy.u_of_box, policy.grid
        """Command of each box [m/s^2], shape (270,); None without a table of the usual boxes."""
        self.begin()

    def begin(self, *, hanging: bool = False) -> None:
        """Release the pendulum again, or swing it up from hanging if that can be."""
        trial = self._simulation.draw(1, self._number).trial(0)
        self._number += 1
        acting, phi = self.policy, radians(self.scene.lean_deg)
        if hanging and self.swing_up is not None:
            acting, phi = self.swing_up, pi
        self.loop.reset(trial._replace(start=(0.0, 0.0, phi, 0.0)))
        self._follow(acting)

    def _follow(self, acting: Policy) -> None:
        """Let a policy act from its start."""
        acting.reset()
        self._acting, self._tick, self.fallen, self.box = acting, 0, "", -1

    def advance(self) -> None:
        """Advance by one tick; a fall is shown for `FALL`, then the arm swings the pendulum up.

        The pendulum is released again instead if that cannot be: see `swing_up`, or the flange has
        not come back.
        """
        loop = self.loop
        if self.fallen and self._tick * self.h > FALL:
            if self.swing_up is None or self._cause != TRUNCATED:
                self.begin()
            else:
                loop.controller.estimate.bias[0] = 0.0  # the fall has changed it
                self._follow(self.swing_up)
        observation = predicted(loop)
        if self.fallen:
            x, x_dot = loop.state()[:2]
            self.u = float(np.clip(-RETURN * (RETURN * x + 2.0 * x_dot), -U_MAX, U_MAX))
        else:
            acting = self._acting
            self.u = float(acting.act(observation))
            if isinstance(acting, SwingUpPolicy) and acting.balancing and not loop.balancing:
                loop.balancing, self._tick = True, 0
        self._cause = cause = loop.step(self.u)
        self._tick += 1
        lasted = self._tick * self.h
        if cause == TRUNCATED and not loop.balancing and lasted > time_limit(loop.params.pendulum):
            cause = NOT_UPRIGHT
        if cause != TRUNCATED and not self.fallen:
            what = "It fell" if loop.balancing else "The swing-up ended"
            self.fallen = f"{what} after {lasted:.1f} s ({TRIAL_OUTCOMES[cause]})."
            loop.balancing, self._tick = False, 0
        self.q, self.phi, self.box = loop.joints(), float(loop.state()[2]), -1
        inside = abs(observation[2]) < PHI_LIMIT and abs(observation[0]) < X_LIMIT
        if self.u_of_box is not None and inside and loop.balancing:
            self.box = int(box_indices(observation[None, :], self._grid)[0])

    def sentences(self) -> tuple[str, str, str, str]:
        """Return the policy, the scene, the motion so far, and the effect of the latency."""
        what = "It has been up" if self.loop.balancing else "The arm has been swinging it up"
        motion = self.fallen or f"{what} for {self._tick * self.h:.0f} s."
        transport, latency = self.scene.delay_ms, 1e3 * self.latency
        effect = (
            f"A command acts after {latency:.0f} ms: {transport:.0f} ms transport + "
            f"{latency - transport:.0f} ms servo. "
            f"Meanwhile a lean grows by {100.0 * (self.growth - 1.0):.0f} %."
        )
        return f"Policy: {self.scene.policy}.", self.scene.about, motion, effect


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
        self._server, self._page = server, RigPage(server, "Equipoise playground")
        compiling = "Compiling the twin: about 20 s the first time, then 3 s."
        self._page.describe("starting", GREY, [compiling])
        self.playground = Playground(scene, yours)
        """The twin behind the page."""
        self._page.show_arm(self.playground.policy.arm)
        user = self._page.on_user_event
        self._page.pendulum.on_drag("left")(user(self._dragged))
        gui: Any = server.gui
        pushes = gui.add_button_group("Push", ("◀ push left", "push right ▶"), order=10)
        pushes.on_click(
            user(lambda _: self.playground.loop.push(PUSH if "right" in pushes.value else -PUSH))
        )
        again = gui.add_button("Release again", order=11)
        again.on_click(user(lambda _: self.playground.begin()))
        self._swing_up = gui.add_button("Swing up", order=12)
        self._swing_up.on_click(user(lambda _: self.playground.begin(hanging=True)))
        with gui.add_folder("The rig", order=50):
            chosen = next((name for name, other in SCENES.items() if other == scene), "balance")
            scenes = gui.add_dropdown("scene", tuple(SCENES), initial_value=chosen)
            policies = tuple(self.playground.policies)
            self._controls: dict[str, Any] = {
                "policy": gui.add_dropdown("policy", policies, initial_value=scene.policy),
                "predict": gui.add_checkbox("prediction", scene.predict),
            }
            for name, (label, low, high, step) in SLIDERS.items():
                value = getattr(scene, name)
                self._controls[name] = gui.add_slider(label, low, high, step, value)
        scenes.on_update(user(lambda _: self._take(SCENES[scenes.value])))
        for control in self._controls.values():
            control.on_update(user(lambda _: self._changed()))
        self._table = gui.add_folder("The table: 270 boxes", order=51)
        with self._table:
            self._boxes = gui.add_html(self._drawn_table())

    def _changed(self) -> None:
        """Set the scene of the controls up."""
        values = {name: control.value for name, control in self._controls.items()}
        self.playground.set(self.playground.scene._replace(**values))

    def _take(self, scene: Scene) -> None:
        """Set a scene up, and move the controls there."""
        for name, control in self._controls.items():
            control.value = getattr(scene, name)
        self.playground.set(scene)

    def _dragged(self, event: Any) -> None:
        """Push the pendulum when the mouse lets it go, as far as it was drawn along the track."""
        if event.phase == "end":
            drawn = event.end_position[0] - event.start_position[0]
            # 120 deg/s for a metre of the mouse in the scene, 60 deg/s at most.
            self.playground.loop.push(radians(float(np.clip(120.0 * drawn, -60.0, 60.0))))

    def advance(self, picture: int) -> None:
        """Advance by one picture.

        Args:
            picture: Number of the picture.
        """
        with self._page.lock, self._server.atomic():
            twin = self.playground
            for _ in range(PICTURE):
                twin.advance()
            self._page.show(twin.q, remainder(twin.phi, 2.0 * pi), twin.u)
            if picture % 12 == 0:  # texts change twice a second
                name, colour = "swinging up", BLUE
                if twin.loop.balancing:
                    name, colour = "balancing", GREEN
                if twin.fallen:
                    name, colour = "fallen", VERMILION
                self._page.describe(name, colour, twin.sentences())
                self._swing_up.visible = twin.swing_up is not None
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
            pen = f'stroke="{INK}" stroke-width="3"' if box == twin.box else f'stroke="{PALE}"'
            parts.append(
                f'<rect x="{left}" y="{top}" width="{cell - 2}" height="{cell - 2}" {pen} '
                f'fill="{VERMILION if u > 0.0 else BLUE}" fill-opacity="{abs(u) / U_MAX:.2f}"/>'
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
            f'<b style="color:{BLUE}">■</b> left; a strong colour is a strong push. '
            "The framed box is in use.",
        )

    def run(self, stopped: Callable[[], bool]) -> None:
        """Advance in real time until stopped; `stopped` is called for each picture."""
        due, picture = time.monotonic(), 0
        while not stopped():
            self.advance(picture)
            picture += 1
            due += PICTURE * self.playground.h
            now = time.monotonic()
            if now - due > 0.2:  # [s]: go on later instead of faster
                due = now
            time.sleep(max(due - now, 0.0))
