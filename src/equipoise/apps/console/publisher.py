"""State of a simulated rig or trial, published for a console through shared memory."""

from collections.abc import Generator, Sequence
from contextlib import contextmanager
from math import nan

import numpy as np
import numpy.typing as npt

from equipoise.control.ticks import OperatorMessage
from equipoise.logs.recorder import Recorder, push_event
from equipoise.logs.shared import RunInfo, open_recorder, share

Floats = npt.NDArray[np.float64]


class Publisher:
    """Writer of states and messages, and reader of the words of the console."""

    def __init__(self, recorder: Recorder) -> None:
        """Write into the memory of a run."""
        self._recorder, self._unknown = recorder, np.full(recorder.joints, nan)

    def show(
        self,
        time: float,
        q: Sequence[float] | Floats,
        phi: float,
        *,
        commanded: Sequence[float] | Floats | None = None,
        u: float = nan,
    ) -> None:
        """Publish a state.

        Args:
            time: Time of the state [s].
            q: Joints of the arm [rad], shape (joints,).
            phi: Angle of the pendulum from upright [rad].
            commanded: Commanded joints [rad], shape (joints,); without them no ghost is shown.
            u: Commanded acceleration of the flange [m/s^2].
        """
        rings, unknown = self._recorder.rings, self._unknown
        self._recorder.take()  # there is no log to drain them
        rings["reply"].push(time, nan, q, unknown, nan)
        aim = unknown if commanded is None else commanded
        rings["tick"].push(time, nan, nan, 0, nan, nan, nan, nan, 0, u, phi, nan, nan, aim, unknown)

    def say(self, time: float, text: str) -> None:
        """Publish a message."""
        push_event(self._recorder.event, time, OperatorMessage("notice", text))

    def words(self) -> list[str]:
        """Return the words of the console since the last call."""
        rows = self._recorder.console.take()["word"].tolist()
        return [word.decode("utf-8", "ignore") for word in rows]


@contextmanager
def publishing(info: RunInfo) -> Generator[Publisher]:
    """Publish a simulated rig or trial for the consoles of this user.

    Raises:
        OutsideError: The memory cannot be created.
    """
    with share(info) as folder:
        yield Publisher(open_recorder(folder, len(info.arm.joints)))
