"""Export of a film in a thread of its own, with progress, for the browser."""

import re
import tempfile
import threading
from pathlib import Path
from typing import Final

from equipoise.apps.report.pictures import write_video
from equipoise.errors import EquipoiseError
from equipoise.logs.run_log import RunLog

UNSAFE: Final = re.compile(r"[^A-Za-z0-9._+-]+")
"""Characters that the name of a download does not take from that of the log."""


class _CancelledError(Exception):
    """The export shall end."""


class FilmExport:
    """A film that is being made, or is done."""

    def __init__(self, run: RunLog, title: str, begin: float, end: float, suffix: str) -> None:
        """Begin to draw.

        Args:
            run: The run.
            title: Name of the log, for the name of the film.
            begin: Start since the release [s].
            end: End since the release [s].
            suffix: `.mp4` or `.webp`.
        """
        self.name = f"{UNSAFE.sub('-', title)[:80]}_{begin:.2f}_to_{end:.2f}_s{suffix}"
        """Name of the file for the download."""
        self.share = 0.0
        """Share of the frames that are done."""
        self.content: bytes | None = None
        """The film; None until it is done."""
        self.error = ""
        """Reason of a failure; empty without one."""
        self._run, self._part = run, (begin, end)
        self._cancelled = threading.Event()
        self._thread = threading.Thread(target=self._draw, daemon=True)
        self._thread.start()

    @property
    def running(self) -> bool:
        """Whether the film is still being made."""
        return self._thread.is_alive()

    def cancel(self) -> None:
        """End the work, and wait until it has ended."""
        self._cancelled.set()
        self._thread.join()

    def _report(self, share: float) -> None:
        if self._cancelled.is_set():
            raise _CancelledError
        self.share = share

    def _draw(self) -> None:
        begin, end = self._part
        try:
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder) / self.name
                arm = self._run.conditions.arm
                write_video(self._run, arm, path, begin=begin, end=end, report=self._report)
                self.content = path.read_bytes()
        except _CancelledError:
            self.error = "cancelled"
        except EquipoiseError as error:
            self.error = str(error)
        except OSError as error:
            self.error = f"the film cannot be written: {error.strerror or error}"
