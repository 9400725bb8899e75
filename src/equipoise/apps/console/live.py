"""Live console of a run: the rig in 3-D, plots, messages, questions and their buttons.

All browsers see the same. The one that has the controls may answer; any other takes them over by a
button. Every browser can stop the run.
"""

import threading
from collections import deque
from contextlib import suppress
from functools import partial
from math import degrees, isfinite, nan
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from equipoise.apps.console.gauges import messages_list, note, question_card
from equipoise.apps.console.panel import RigPanel
from equipoise.apps.console.plots import QUANTITIES, Plots
from equipoise.apps.console.watch import Observation, RunWatch
from equipoise.apps.style import BLUE, GREEN, GREY, INK, VERMILION
from equipoise.control.ticks import OK
from equipoise.logs.recorder import LoggedEvent
from equipoise.outcomes import Phase
from equipoise.rig.processes import HEARTBEAT_TIMEOUT

if TYPE_CHECKING:
    import viser

SPAN: Final = 10.0
"""Time shown in the plots [s]."""
MESSAGES: Final = 40
"""Number of messages that are kept."""
PHASE_COLOURS: Final = {
    Phase.BALANCING: GREEN,
    Phase.ARMED: GREEN,
    Phase.STOPPING: VERMILION,
}
"""Colours of the phases; the others are blue."""
EVENT_COLOURS: Final = {"fault": VERMILION, "stopping": VERMILION, "warning": "#8a5a00"}
"""Colours of messages by the names of their events; the others are black."""
DENIAL: Final = "n"
"""Answer that denies; any question with one word takes it too."""


class LivePage:
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
        self._question: LoggedEvent | None = None
        self._history: deque[tuple[float, ...]] = deque()
        self._messages: deque[LoggedEvent] = deque(maxlen=MESSAGES)
        self._began = self._ended = nan
        self.ended = False
        """Whether the run that is shown has ended."""
        self._panel = RigPanel(server, "Equipoise console")
        self._plots = Plots(server.gui, len(QUANTITIES), 50.0)
        with server.gui.add_folder("Messages", order=60):
            self._listed = server.gui.add_html("")
        self._panel.say("no run", GREY, ["Waiting for a run on this computer."])
        server.on_client_connect(self._connect)
        server.on_client_disconnect(self._disconnect)

    def begin(self, watch: RunWatch) -> None:
        """Show another run from its begin."""
        with self._lock:
            self._watch, self.ended = watch, False
            self._panel.show_arm(watch.info.arm)
            self._history.clear()
            self._messages.clear()
            self._began = self._ended = nan
            self._panel.say("connecting", BLUE, [watch.info.title])
            self._list_messages()
            self._refresh()

    def show(self, now: Observation) -> None:
        """Show the state of the run."""
        with self._lock, self._server.atomic():
            if self._watch is None:
                return
            self._messages.extend(now.events)
            if now.events:
                self._list_messages()
            x = self._panel.show(now.q, now.phi, commanded=now.commanded, u=now.u)
            if self._history and now.time < self._history[-1][0]:  # a rig that began again
                self._history.clear()
            if isfinite(now.late):
                late = 1e3 * max(now.late, 0.0)
                self._history.append((now.time, degrees(now.phi), 1e3 * x, now.u, late))
                self._draw_plots()
            if now.phase is Phase.BALANCING:
                self._began = self._began if isfinite(self._began) else now.time
                self._ended = now.time
            self._describe(self._watch, now)
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

    def take_controls(self, client: int) -> None:
        """Give the controls to a browser."""
        with self._lock:
            self._holder = client
            self._refresh()

    def answer(self, client: int, word: str, question: float) -> None:
        """Send the answer of a browser, if it has the controls.

        Args:
            client: Number of the browser.
            word: The answer, or an action.
            question: Time of the question [s]; 0 for an action.
        """
        with self._lock:
            if self._watch is not None and client == self._holder:
                self._watch.say(word, question)

    def _describe(self, watch: RunWatch, now: Observation) -> None:
        """Show the state in words."""
        name, colour = "emulated rig" if watch.info.actions else "before the motion", BLUE
        if now.phase is not None:
            name, colour = now.phase.value, PHASE_COLOURS.get(now.phase, BLUE)
        lines = [watch.info.title]
        if isfinite(self._began):
            length = f" of {watch.info.duration:g} s" if watch.info.duration else ""
            lines.append(f"balanced {self._ended - self._began:.1f} s{length}")
        if now.silence > HEARTBEAT_TIMEOUT:
            name, colour = "the loop does not answer", VERMILION
            lines.append(f"no tick for {now.silence:.2f} s; press the E-stop if the arm moves")
        if now.ended:
            name, colour = "ended", INK
        if self._messages and now.question is None:
            newest = self._messages[-1]
            lines.append(newest.text or newest.name)
        self._panel.say(name, colour, lines)

    def _list_messages(self) -> None:
        rows = [
            ((event.text or event.name), EVENT_COLOURS.get(event.name, INK))
            for event in self._messages
        ]
        self._listed.content = messages_list(rows)

    def _draw_plots(self) -> None:
        history = self._history
        while history[0][0] < history[-1][0] - SPAN:
            history.popleft()
        time, *rows = np.array(history).T
        rows[0] = np.unwrap(rows[0][::-1], period=360.0)[::-1]  # the newest one stays
        self._plots.draw(time - time[-1], np.array(rows))

    def _connect(self, client: "viser.ClientHandle") -> None:
        with self._lock:
            self._clients[client.client_id] = _ClientControls(client, self)
            if self._holder not in self._clients:
                self._holder = client.client_id
            self._refresh()

    def _disconnect(self, client: "viser.ClientHandle") -> None:
        with self._lock:
            self._clients.pop(client.client_id, None)
            if self._holder == client.client_id:
                self._holder = None
            self._refresh()

    def _refresh(self) -> None:
        """Show the open question and the buttons of each browser."""
        actions = self._watch.info.actions if self._watch is not None else ()
        for controls in self._clients.values():
            with suppress(RuntimeError):  # this browser has just gone
                controls.show(self._question, actions, self._holder)


class _ClientControls:
    """Question and buttons of one browser."""

    def __init__(self, client: "viser.ClientHandle", page: LivePage) -> None:
        self._client, self._page = client, page
        self._number = client.client_id
        self._buttons: list[Any] = []
        self._asked = client.gui.add_html("", order=10, visible=False)
        self._note = client.gui.add_html("", order=30)
        self._take = client.gui.add_button("Take the controls", color="orange", order=31)
        self._take.on_click(lambda _: page.take_controls(self._number))

    def show(
        self, question: LoggedEvent | None, actions: tuple[str, ...], holder: int | None
    ) -> None:
        """Show a question with its buttons, or actions; without the controls they are disabled."""
        mine = holder == self._number
        whose = "You have" if mine else "Nobody has" if holder is None else "Another browser has"
        with self._client.atomic():  # no question with the buttons of the one before
            if question is not None:
                self._asked.content = question_card(question.text)
            self._asked.visible = question is not None
            text = f"{whose} the controls. STOP works in every browser."
            self._note.content, self._take.visible = note(text, "controls"), not mine
            for button in self._buttons:
                button.remove()
            words = dict.fromkeys(actions) if question is None else answers(question)
            asked = 0.0 if question is None else question.time
            self._buttons = [
                self._add(place, word, label or word, asked, mine)
                for place, (word, label) in enumerate(words.items())
            ]

    def _add(self, place: int, word: str, label: str, question: float, mine: bool) -> Any:
        look: Any = {"color": "gray" if word == DENIAL else "green", "disabled": not mine}
        button = self._client.gui.add_button(label, order=11.0 + place, **look)
        answer = partial(self._page.answer, self._number, word, question)
        button.on_click(lambda _: answer())
        return button


def answers(question: LoggedEvent) -> dict[str, str]:
    """Return the answers to a question with the labels of their buttons.

    A question with one word, which is typed to acknowledge it, has a denial as well.

    Example:
        >>> answers(LoggedEvent(1.0, "move", ("y", "n"), "Move?"))
        {'y': 'Yes', 'n': 'No'}
        >>> answers(LoggedEvent(2.0, "checklist", ("fence",), "Is the fence closed?"))
        {'fence': 'Yes: fence', 'n': 'No'}
    """
    labels = {"y": "Yes", "n": "No", OK: "OK"}
    words = {word: labels.get(word, f"Yes: {word}") for word in question.answers}
    return words | ({DENIAL: "No"} if question.name == "checklist" else {})
