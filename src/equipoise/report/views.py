"""Values as figures and as HTML: `equipoise.views` finds both functions here."""

import base64
from functools import singledispatch
from typing import TYPE_CHECKING

from equipoise.control.policy import TabularPolicy
from equipoise.errors import InputError, RecordingError
from equipoise.evaluation import Evaluation
from equipoise.logs.run_log import RunLog
from equipoise.model.pendulum import Pendulum
from equipoise.report import figures
from equipoise.report.markup import escape
from equipoise.report.style import to_svg

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@singledispatch
def plot(value: object) -> "Figure":
    """Return a matplotlib figure of a value.

    Args:
        value: Pendulum (its free swing), policy (its table), evaluation (survival) or run (angle).

    Raises:
        InputError: The value is of another kind.
        RecordingError: No policy acted in a run.
    """
    raise InputError(f"{type(value).__name__} has no figure; give a pendulum, policy or run")


@plot.register(Pendulum)
def _(value: Pendulum) -> "Figure":
    return figures.predicted_swing(value)


@plot.register(TabularPolicy)
def _(value: TabularPolicy) -> "Figure":
    return figures.policy_picture(value)


@plot.register(Evaluation)
def _(value: Evaluation) -> "Figure":
    return figures.survival(value)


@plot.register(RunLog)
def _(value: RunLog) -> "Figure":
    if not len(value.time):
        raise RecordingError("no policy acted in this run; plot a run of `deploy`")
    return figures.pendulum(value)


def html(value: object) -> str:
    """Return a value as HTML: its one line, and its figure where it has one."""
    line = f"<p><code>{escape(repr(value))}</code></p>"
    try:
        picture = base64.b64encode(to_svg(plot(value)).encode()).decode()
    except RecordingError:
        return line
    # As an image an SVG runs no script, whatever text is in it.
    return f'{line}<img alt="" style="max-width:100%" src="data:image/svg+xml;base64,{picture}">'
