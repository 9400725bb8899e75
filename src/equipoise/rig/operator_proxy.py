"""The operators of a run, for the process of its loop: rings to the parent and from a console."""

import os
import time
from typing import Final

from equipoise.control.ticks import OperatorMessage
from equipoise.logs.recorder import Question, Recorder, push_event
from equipoise.rig.run import ALONE, STOP

ASIDE: Final = ("warning", "nudge")
"""Names of messages beside an open question."""
CONSOLE: Final = "console"
"""Name of the message with a word from a console."""


class OperatorProxy:
    """Operator interface of the loop's process.

    The first answer to a question counts. A console names the question that it answers, so that a
    later answer is not taken for another question, or for a key that stops the run.
    """

    def __init__(self, recorder: Recorder) -> None:
        """Connect to the rings of a run."""
        self._recorder = recorder
        self._asked = self._open = 0
        self._parent = os.getppid()
        self.signals: list[str] = []
        """Stops that signals to this process request."""

    def notify(self, event: OperatorMessage) -> None:
        """Send a message to the operators; never blocks."""
        push_event(self._recorder.notices, time.monotonic(), event.name, event.answers, event.text)
        if event.answers:
            self._asked += 1
            self._open = self._asked
            self._recorder.ask(Question(self._asked, event.name, event.answers, event.text))
        elif event.name not in ASIDE:
            self._close()

    def read_input(self) -> list[str]:
        """Return the words of the operators, the oldest first."""
        words = [word.decode("utf-8", "ignore") for word in self._recorder.typed.take()["word"]]
        if any(words):  # Enter alone may be no answer
            self._close()
        for number, data in self._recorder.console.take().tolist():
            word = data.decode("utf-8", "ignore")
            if word == STOP or number == self._open > 0:
                self._close()
                words.append(word)
                self.notify(OperatorMessage(CONSOLE, f"Console: {word}"))
        words += self.signals
        self.signals.clear()
        if os.getppid() != self._parent:
            self._parent = os.getppid()
            words.append(ALONE)
        return words

    def _close(self) -> None:
        """Withdraw the open question."""
        if self._open:
            self._open = 0
            self._recorder.ask(None)
