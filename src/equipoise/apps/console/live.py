"""Live console of a run: the rig in 3-D, plots, messages, questions and their buttons.

All browsers see the same, and each can answer and stop the run.
"""

import threading
from collections import deque
from functools import partial
from math import degrees, isfinite, nan
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from equipoise.apps.console.scene import PLOTS, RigPage, card, messages_list, shown
from equipoise.apps.console.watch import Observation, RunWatch
from equipoise.apps.style import BLUE, GREEN, GREY, INK, ORANGE, VERMILION
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
COLOURS: Final = {
    **{Phase.BALANCING: GREEN, Phase.ARMED: GREEN, Phase.STOPPING: VERMILION},
    **{"fault": VERMILION, "stopping": VERMILION, "warning": "#8a5a00"},
}
"""Colours of phases and of messages by the names of their events; others are blue and black."""


class LivePage:
    """Content of all browsers."""

    def __init__(self, server: "viser.ViserServer") -> None:
        """Fill a server's page.

        Args:
            server: The viser server.
        """
        self._server = server
        self._watch: RunWatch | None = None
        self._lock = threading.RLock()
        self._question: LoggedEvent | None = None
        self._buttons: list[Any] = []
        self._history: deque[tuple[float, ...]] = deque()
        self._messages: deque[LoggedEvent] = deque(maxlen=MESSAGES)
        self._began = self._ended = nan
        self.ended = False
        """Whether the run that is shown has ended."""
        self._page = RigPage(server, "Equipoise console", plots=len(PLOTS))
        self._asked = server.gui.add_html("", order=10, visible=False)
        with server.gui.add_folder("Messages", order=60):
            self._listed = server.gui.add_html("")
        self._page.describe("no run", GREY, ["Waiting for a run on this computer."])

    def begin(self, watch: RunWatch) -> None:
        """Show another run from its begin."""
        with self._lock:
            self._watch, self.ended = watch, False
            self._page.show_arm(watch.info.arm)
            self._history.clear()
            self._messages.clear()
            self._began = self._ended = nan

    def show(self, now: Observation) -> None:
        """Show the state of the run."""
        with self._lock, self._server.atomic():
            if self._watch is None:
                return
            self._messages.extend(now.events)
            self._listed.content = messages_list(
                (event.text or event.name, COLOURS.get(event.name, INK)) for event in self._messages
            )
            x = self._page.show(now.q, now.phi, now.u)
            if isfinite(now.late):
                late = 1e3 * max(now.late, 0.0)
                self._history.append((now.time, degrees(now.phi), 1e3 * x, now.u, late))
                self._draw_plots()
            if now.phase is Phase.BALANCING:
                self._began = self._began if isfinite(self._began) else now.time
                self._ended = now.time
            self._describe(self._watch, now)
            self._ask(now.question)

    def end(self) -> None:
        """Show that the run has ended; its last picture stays."""
        with self._lock:
            self._watch, self.ended = None, True
            self._ask(None)

    def stop(self) -> str:
        """Send a stop to the run; return a text for the STOP button. Never blocks."""
        watch = self._watch
        if watch is None:
            return "no run to stop"
        watch.say("stop")
        return "stop sent"

    def _describe(self, watch: RunWatch, now: Observation) -> None:
        """Show the state in words."""
        name, colour, lines = "before the motion", BLUE, [watch.info.title]
        if now.phase is not None:
            name, colour = now.phase.value, COLOURS.get(now.phase, BLUE)
        if isfinite(self._began):
            length = f" of {watch.info.duration:g} s" if watch.info.duration else ""
            lines.append(f"balanced {self._ended - self._began:.1f} s{length}")
        if now.silence > HEARTBEAT_TIMEOUT:
            name, colour = "the loop does not answer", VERMILION
            lines.append(f"no tick for {now.silence:.2f} s; press the E-stop if the arm moves")
        if now.ended:
            name, colour = "ended", INK
        self._page.describe(name, colour, lines)

    def _draw_plots(self) -> None:
        history = self._history
        while history[0][0] < history[-1][0] - SPAN:
            history.popleft()
        time, *rows = np.array(history).T
        rows[0] = np.unwrap(rows[0][::-1], period=360.0)[::-1]  # the newest one stays
        self._page.draw(time - time[-1], np.array(rows))

    def _ask(self, question: LoggedEvent | None) -> None:
        """Show a question with its buttons."""
        if question == self._question:
            return
        self._question = question
        for button in self._buttons:
            button.remove()
        self._buttons, self._asked.visible = [], question is not None
        if question is None:
            return
        look = f"font-size:16px;font-weight:600;border-left:5px solid {ORANGE};background:#fff7e6"
        self._asked.content = card("question", shown(question.text), look)
        for place, (word, label) in enumerate(answers(question).items()):
            button = self._server.gui.add_button(label, order=11.0 + place)
            answer = partial(self._answer, word, question.time)
            button.on_click(lambda _, answer=answer: answer())
            self._buttons.append(button)

    def _answer(self, word: str, question: float) -> None:
        """Send an answer; the run takes the first one to the question of a time [s]."""
        watch = self._watch
        if watch is not None:
            watch.say(word, question)


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
    return words | ({"n": "No"} if question.name == "checklist" else {})
