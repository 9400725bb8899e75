"""Plots of values, by `plot()` and in notebooks.

Values must not import the report, which draws them. So `import equipoise` registers a loader of the
drawing module here, and the first plot loads that module.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Protocol

from equipoise.errors import InputError

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Views(Protocol):
    """Module that draws values."""

    def plot(self, value: object, /) -> "Figure":
        """Return a figure of a value."""
        ...

    def html(self, value: object, /) -> str:
        """Return a value as HTML."""
        ...


def _unregistered() -> Views:
    raise InputError("no drawing module is registered; import equipoise, which registers it")


_load: Callable[[], Views] = _unregistered


def register(load: Callable[[], Views]) -> None:
    """Register the function that returns the module that draws."""
    global _load
    _load = load


class Viewable:
    """Base of values with a figure; notebooks show the figure below the value."""

    def plot(self) -> "Figure":
        """Return a matplotlib figure of the value.

        Raises:
            RecordingError: The value holds no data to draw, such as a run without a policy.
        """
        return _load().plot(self)

    def _repr_html_(self) -> str:
        return _load().html(self)
