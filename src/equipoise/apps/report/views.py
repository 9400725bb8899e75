"""Values as figures and as HTML; `equipoise.views` loads this module on first use."""

import base64
from typing import TYPE_CHECKING

from equipoise.apps.report import figures
from equipoise.apps.report.markup import escape
from equipoise.apps.report.style import render
from equipoise.control.policy import TabularPolicy
from equipoise.errors import InputError, RecordingError
from equipoise.logs.run_log import RunLog
from equipoise.model.pendulum import Pendulum
from equipoise.worlds.evaluation import Evaluation

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def plot(value: object) -> "Figure":
    """Return a matplotlib figure of a value.

    Args:
        value: Pendulum (its free swing), policy (its table), evaluation (survival) or run (angle).

    Raises:
        InputError: The value is of another kind.
        RecordingError: No policy acted in a run.
    """
    match value:
        case Pendulum():
            return figures.predicted_swing(value)
        case TabularPolicy():
            return figures.policy_picture(value)
        case Evaluation():
            return figures.survival(value)
        case RunLog():
            if not len(value.time):
                raise RecordingError("no policy acted in this run; plot a run of `deploy`")
            return figures.pendulum(value)
        case _:
            raise InputError(
                f"{type(value).__name__} has no figure; give a pendulum, policy or run"
            )


def html(value: object) -> str:
    """Return a value as HTML: its one-line representation, and its figure if available."""
    line = f"<p><code>{escape(repr(value))}</code></p>"
    try:
        picture = base64.b64encode(render(plot(value), "svg")).decode()
    except RecordingError:
        return line
    # Browsers never run scripts of an SVG inside an `img`.
    return f'{line}<img alt="" style="max-width:100%" src="data:image/svg+xml;base64,{picture}">'
