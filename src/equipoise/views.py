"""Plots of values, by `plot()` and in notebooks.

Values must not import the report, which draws them: the first plot loads `apps.report.views`.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Viewable:
    """Base of values with a figure; notebooks show the figure below the value."""

    def plot(self) -> "Figure":
        """Return a matplotlib figure of the value.

        Raises:
            RecordingError: The value holds no data to draw, such as a run without a policy.
        """
        return _drawing().plot(self)

    def _repr_html_(self) -> str:
        return _drawing().html(self)


def _drawing() -> Any:
    return import_module("equipoise.apps.report.views")
