"""Page of the console: the rig in 3-D, gauges, plots, messages, questions and their buttons.

All browsers see the same. The one that has the controls may answer; any other takes them over by a
button. Every browser can stop the run.
"""

import re
import threading
from collections import deque
from contextlib import suppress
from functools import partial
from math import degrees, isfinite, nan
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from equipoise.apps.console.gauges import (
    checks_table,
    gauges,
    messages_list,
    phase_colour,
    question_card,
    state_card,
)
from equipoise.apps.console.scene import RigView
from equipoise.apps.console.watch import Observation, RunWatch
from equipoise.apps.report.style import BLUE, GREEN, GREY, INK, PURPLE, VERMILION
from equipoise.control.ticks import OK
from equipoise.logs.recorder import WORD_TYPED, LoggedEvent, Question
from equipoise.outcomes import Phase
from equipoise.rig.processes import HEARTBEAT_TIMEOUT

if TYPE_CHECKING:
    import viser

SPAN: Final = 10.0
"""Time shown in the plots [s]."""
PLOT_HEIGHT: Final = 84
"""Height of a plot without the axis of time [px]."""
TIME_AXIS: Final = 24
"""Height of the axis of time below the last plot [px]."""
PANEL_WIDTH: Final = 380.0
"""Width of the panel beside the scene [px]."""
MESSAGES: Final = 40
"""Number of messages that are kept."""
PLOTS: Final = {
    "phi": ("φ [deg]", BLUE, -2.0, 2.0),
    "x": ("x [mm]", GREEN, -20.0, 20.0),
    "u": ("u [m/s²]", PURPLE, -2.0, 2.0),
    "late": ("lateness of the ticks [ms]", VERMILION, 0.0, 1.0),
}
"""Title, colour and smallest range of each plot."""
DENIAL: Final = "n"
LABELS: Final = {"y": "Yes", "n": "No", OK: "OK"}
"""Labels of answers; other answers are shown as they are."""
INSTRUCTION: Final = re.compile(r"( Type \S+\.| y or n)$")
"""End of a question for those who type."""
HANG: Final = np.pi
"""Angle of a hanging pendulum, shown while the angle is unknown [rad]."""


class ConsolePage:
    """Content of all browsers."""

    def __init__(self, server: "viser.ViserServer") -> None:
        """Fill a server's page.

        Args:
            server: The viser server.
        """
        self._server, self._watch = server, None
        self._lock = threading.RLock()
        self._clients: dict[int, _ClientControls] = {}
        self._holder: int | None = None
        self._view: RigView | None = None
        self._question: Question | None = None
        self._history: deque[tuple[float, ...]] = deque()
        self._findings: list[LoggedEvent] = []
        self._messages: deque[LoggedEvent] = deque(maxlen=MESSAGES)
        self._began = self._ended = nan
        self.ended = False
        """Whether the run that is shown has ended."""
        gui = server.gui
        gui.configure_theme(show_logo=False, show_share_button=False)
        gui.set_panel_label("Equipoise console")
        gui.main_panel.dock_right()
        gui.main_panel.set_width(PANEL_WIDTH)
        server.scene.configure_environment_map("studio", environment_intensity=0.5)
        self._state = gui.add_html("", order=0)
        self._gauges = gui.add_html(gauges(nan, nan), order=40)
        self._plots = {
            name: self._add_plot(place, *kind)
            for place, (name, kind) in enumerate(PLOTS.items(), start=50)
        }
        with gui.add_folder("Messages", order=60):
            self._listed = gui.add_html("")
        with gui.add_folder("Checks before the run", order=70) as self._checks_folder:
            self._checks = gui.add_html("")
        self._checks_folder.visible = False
        self._say_state("no run", GREY, ("Waiting for a run on this computer.",))
        server.on_client_connect(self._connect)
        server.on_client_disconnect(self._disconnect)

    def begin(self, watch: RunWatch) -> None:
        """Show another run from its begin."""
        with self._lock:
            if self._view is not None:
                self._view.remove()
            self._watch, self._view = watch, RigView(self._server, watch.info.arm)
            for client in self._server.get_clients().values():
                self._keep_in_view(client)
            self.ended = False
            self._view.show(watch.info.arm.home, HANG)
            self._history.clear()
            self._findings, self._began, self._ended = [], nan, nan
            self._messages.clear()
            self._list_messages()
            self._checks_folder.visible = False
            self._say_state("connecting", BLUE, (watch.info.title,))
            self._refresh()

    def show(self, now: Observation) -> None:
        """Show the state of the run."""
        with self._lock, self._server.atomic():
            watch, view = self._watch, self._view
            if watch is None or view is None:
                return
            self._take_events(now.events)
            view.show(
                view.q if now.q is None else now.q,
                now.phi if isfinite(now.phi) else HANG,
                commanded=now.commanded,
                u=now.u,
            )
            if self._history and now.time < self._history[-1][0]:  # the next trial
                self._history.clear()
                self._began = nan
            x = view.x if now.q is not None else nan
            self._gauges.content = gauges(now.phi, x)
            if isfinite(now.late):
                self._history.append(
                    (now.time, degrees(now.phi), 1e3 * x, now.u, 1e3 * max(now.late, 0.0))
                )
                self._draw_plots()
            if now.phase is Phase.BALANCING:
                self._began = self._began if isfinite(self._began) else now.time
                self._ended = now.time
            self._describe(watch, now)
            if now.question != self._question:
                self._question = now.question
                self._refresh()

    def end(self) -> None:
        """Show that the run has ended; its last picture stays."""
        with self._lock:
            self._watch, self._question, self.ended = None, None, True
            self._refresh()

    def stop(self) -> str:
        """Send a stop to the run; return a text for the STOP button. Never blocks."""
        watch = self._watch
        if watch is None:
            return "no run to stop"
        watch.say(watch.info.stop)
        return "stop sent"

    def _describe(self, watch: RunWatch, now: Observation) -> None:
        """Show the state in words."""
        name, colour = "before the motion", BLUE
        if watch.info.actions:
            name = "emulated rig"
        if now.phase is not None:
            name, colour = now.phase.value, phase_colour(now.phase)
        lines = [watch.info.title]
        if isfinite(self._began):
            balanced, length = self._ended - self._began, watch.info.duration
            lines.append(f"balanced {balanced:.1f} s" + (f" of {length:g} s" if length else ""))
        if now.silence > HEARTBEAT_TIMEOUT:
            name, colour = "the loop does not answer", VERMILION
            lines.append(f"no tick for {now.silence:.2f} s; press the E-stop if the arm moves")
        if now.ended:
            name, colour = "ended", INK
        if self._messages and now.question is None:
            lines.append(self._messages[-1].text or self._messages[-1].name)
        self._say_state(name, colour, tuple(lines))

    def _say_state(self, name: str, colour: str, lines: tuple[str, ...]) -> None:
        card = state_card(name, colour, lines)
        if self._state.content != card:
            self._state.content = card

    def _take_events(self, events: list[LoggedEvent]) -> None:
        for event in events:
            if event.name == "finding":
                self._findings.append(event)
            elif event.name == WORD_TYPED:
                self._messages.append(event._replace(text=f"answer: {event.text}"))
            else:
                self._messages.append(event)
        if events:
            self._list_messages()
        if self._findings and any(event.name == "finding" for event in events):
            self._checks.content = checks_table(self._findings)
            self._checks_folder.visible = True

    def _list_messages(self) -> None:
        self._listed.content = messages_list(self._messages)

    # The plots.

    def _add_plot(self, order: float, title: str, colour: str, low: float, high: float) -> Any:
        is_last = title == list(PLOTS.values())[-1][0]
        times: Any = {"size": TIME_AXIS, "stroke": INK, "show": is_last}
        axis: Any = {"size": 44, "space": 18, "stroke": INK}
        series: Any = ({}, {"stroke": colour, "width": 1.5, "points": {"show": False}})
        soft: Any = {"pad": 0.1, "mode": 1}
        return self._server.gui.add_uplot(
            (np.array([-SPAN, 0.0]), np.zeros(2)),
            series,
            title=title,
            scales={
                "x": {"time": False, "auto": False, "min": -SPAN, "max": 0.0},
                "y": {"range": {"min": soft | {"soft": low}, "max": soft | {"soft": high}}},
            },
            axes=(times, axis),
            legend={"show": False},
            cursor={"show": False},
            height=PLOT_HEIGHT + TIME_AXIS * is_last,
            padding=(6, 16, 6, 0),
            order=order,
        )

    def _draw_plots(self) -> None:
        history = self._history
        newest = history[-1][0]
        while history[0][0] < newest - SPAN:
            history.popleft()
        columns = np.array(history).T
        columns[1] = np.unwrap(columns[1, ::-1], period=360.0)[::-1]  # the newest one stays
        ago = columns[0] - newest
        for plot, values in zip(self._plots.values(), columns[1:], strict=True):
            known = np.isfinite(values)
            if known.sum() > 1:
                plot.data = (ago[known], values[known])

    # The browsers.

    def _connect(self, client: "viser.ClientHandle") -> None:
        with self._lock:
            self._clients[client.client_id] = _ClientControls(client, self)
            if self._holder not in self._clients:
                self._holder = client.client_id
            self._keep_in_view(client)
            client.camera.on_update(lambda _: self._keep_in_view(client))
            self._refresh()

    def _keep_in_view(self, client: "viser.ClientHandle") -> None:
        """Keep the rig inside the window of a browser."""
        if self._view is not None:
            self._view.keep_in_view(client)

    def _disconnect(self, client: "viser.ClientHandle") -> None:
        with self._lock:
            self._clients.pop(client.client_id, None)
            if self._holder == client.client_id:
                self._holder = None
            self._refresh()

    def take_controls(self, client: int) -> None:
        """Give the controls to a browser."""
        with self._lock:
            self._holder = client
            self._refresh()

    def answer(self, client: int, word: str, number: int) -> None:
        """Send the answer of a browser, if it has the controls.

        Args:
            client: Number of the browser.
            word: The answer, or an action.
            number: Number of the question; 0 for an action.
        """
        with self._lock:
            if self._watch is not None and client == self._holder:
                self._watch.say(word, number)

    def _refresh(self) -> None:
        """Show the open question and the buttons of each browser."""
        question = self._question
        actions = self._watch.info.actions if self._watch is not None else ()
        for number, controls in self._clients.items():
            with suppress(RuntimeError):  # this browser has just gone
                controls.show(question, actions, self._holder, mine=number == self._holder)


class _ClientControls:
    """Question and buttons of one browser."""

    def __init__(self, client: "viser.ClientHandle", page: ConsolePage) -> None:
        self._client, self._page = client, page
        self._number = client.client_id
        self._buttons: list[Any] = []
        self._asked = client.gui.add_html("", order=10, visible=False)
        self._note = client.gui.add_html("", order=30)
        self._take = client.gui.add_button("Take the controls", color="orange", order=31)
        self._take.on_click(lambda _: page.take_controls(self._number))

    def show(
        self,
        question: Question | None,
        actions: tuple[str, ...],
        holder: int | None,
        *,
        mine: bool,
    ) -> None:
        """Show a question with its buttons, or actions; without the controls they are disabled."""
        with self._client.atomic():  # no question with the buttons of the one before
            if question is not None:
                self._asked.content = question_card(INSTRUCTION.sub("", question.text))
            self._asked.visible = question is not None
            text = "You have the controls." if mine else "Another browser has the controls."
            text = "Nobody has the controls." if holder is None else text
            self._note.content = (
                f'<div id="equipoise-controls" style="font:13px system-ui,sans-serif;color:{GREY};'
                f'padding:2px 12px">{text} STOP works in every browser.</div>'
            )
            self._take.visible = not mine
            for button in self._buttons:
                button.remove()
            self._buttons = []
            if question is not None:
                for word, label in answers(question).items():
                    self._add(word, label, question.number, mine=mine, deny=word == DENIAL)
            for word in actions:
                self._add(word, word, 0, mine=mine, deny=False)

    def _add(self, word: str, label: str, number: int, *, mine: bool, deny: bool) -> None:
        button = self._client.gui.add_button(
            label,
            color="gray" if deny else "green",
            disabled=not mine,
            order=11.0 + len(self._buttons),
        )
        answer = partial(self._page.answer, self._number, word, number)
        button.on_click(lambda _: answer())
        self._buttons.append(button)


def answers(question: Question) -> dict[str, str]:
    """Return the answers to a question with the labels of their buttons.

    A question with one word, which is typed to acknowledge it, has a denial as well.

    Example:
        >>> answers(Question(1, "move", ("y", "n"), "Move? y or n"))
        {'y': 'Yes', 'n': 'No'}
        >>> answers(Question(2, "checklist", ("fence",), "Is the fence closed? Type fence."))
        {'fence': 'Yes: fence', 'n': 'No'}
    """
    words = {word: LABELS.get(word, f"Yes: {word}") for word in question.answers}
    return words | ({DENIAL: "No"} if question.name == "checklist" else {})
