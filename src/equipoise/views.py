"""Pictures of values, by `plot()` and in notebooks.

Values stand below the report, which draws them, and import nothing from it. The package registers
the module that draws when it is imported; that module is loaded with the first picture.
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


def _nothing() -> Views:
    raise InputError("nothing draws values; import equipoise, which registers what does")


_load: Callable[[], Views] = _nothing


def register(load: Callable[[], Views]) -> None:
    """Register the function that returns the module that draws."""
    global _load
    _load = load


class Viewable:
    """Value that can be drawn, and that notebooks show with its figure."""

    def plot(self) -> "Figure":
        """Return a matplotlib figure of the value.

        Raises:
            RecordingError: There is nothing to draw, such as in a run without a policy.
        """
        return _load().plot(self)

    def _repr_html_(self) -> str:
        return _load().html(self)
