"""What all pages share: the rig in 3-D, and a panel with state and gauges."""

from collections.abc import Iterable, Sequence
from math import nan, pi
from typing import TYPE_CHECKING, Any

from equipoise.apps.console.gauges import gauges, state_card
from equipoise.apps.console.rig_view import RigView
from equipoise.model.arms.arm import Arm

if TYPE_CHECKING:
    import viser


class RigPanel:
    """The rig, and the first two entries of the panel beside it."""

    def __init__(self, server: "viser.ViserServer", label: str, arm: Arm | None = None) -> None:
        """Fill a server's page.

        Args:
            server: The viser server.
            label: Title of the panel.
            arm: The arm; None shows none before `show_arm`.
        """
        self._server, self.view = server, None if arm is None else RigView(server, arm)
        server.gui.configure_theme(show_logo=False, show_share_button=False)
        server.gui.set_panel_label(label)
        server.gui.main_panel.dock_right()
        server.gui.main_panel.set_width(380.0)
        server.scene.configure_environment_map("studio", environment_intensity=0.5)
        self._state = server.gui.add_html("", order=0)
        self._gauges = server.gui.add_html(gauges(nan, nan), order=40)
        server.on_client_connect(self._connect)

    def show_arm(self, arm: Arm) -> None:
        """Show another arm, at home with a hanging pendulum."""
        if self.view is not None:
            self.view.remove()
        self.view = RigView(self._server, arm)
        for client in self._server.get_clients().values():
            self.view.keep_in_view(client)

    def show(
        self,
        q: Sequence[float] | Any | None,
        phi: float,
        *,
        x: float | None = None,
        commanded: Sequence[float] | Any | None = None,
        u: float = 0.0,
    ) -> float:
        """Show a posture and its gauges; return the displacement on the gauge [m].

        Args:
            q: Measured joints [rad], shape (joints,); None while unknown.
            phi: Angle of the pendulum from upright [rad]; NaN while unknown, it hangs then.
            x: Displacement of the flange [m]; by default that of the posture.
            commanded: Commanded joints of the ghost [rad], shape (joints,).
            u: Commanded acceleration of the flange [m/s^2].
        """
        view = self.view
        if view is None:
            return nan
        angle = pi if phi != phi else phi
        view.show(view.q if q is None else q, angle, commanded=commanded, u=u)
        if x is None:
            x = nan if q is None else view.x
        self._gauges.content = gauges(phi, x)
        return x

    def say(self, name: str, colour: str, lines: Iterable[str]) -> None:
        """Show the state in large letters, with sentences below."""
        card = state_card(name, colour, lines)
        if self._state.content != card:
            self._state.content = card

    def _connect(self, client: "viser.ClientHandle") -> None:
        def keep(_: object = None) -> None:
            if self.view is not None:
                self.view.keep_in_view(client)

        keep()
        client.camera.on_update(keep)
