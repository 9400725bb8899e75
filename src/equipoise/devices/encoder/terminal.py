"""An emulated board on a pseudo-terminal: a serial port without a cable.

Whoever opens it cannot tell it from a board on USB. Linux and macOS only.
"""

import contextlib
import os
import sys
from pathlib import Path
from typing import Final

from equipoise.devices.encoder.board import Board
from equipoise.errors import InputError, OutsideError

CHUNK: Final = 4096
"""Bytes that are read at once."""


class Terminal:
    """A pseudo-terminal with a board behind it."""

    def __init__(self, board: Board, link: Path | None = None) -> None:
        """Open the terminal.

        Args:
            board: What is behind it; one that is not listened to drops lines, as a real one does.
            link: A second name, as a symbolic link; a link to another terminal, or to nothing,
                is replaced.

        Raises:
            InputError: A file, or a link to one, has that name.
            OutsideError: There are no pseudo-terminals here, or the link cannot be made.
        """
        try:
            import pty
            import tty

            self._ours, self._theirs = pty.openpty()
        except ImportError:
            raise OutsideError(
                f"{sys.platform} has no pseudo-terminals, on which an encoder's board is emulated; "
                "use Linux or macOS"
            ) from None
        except OSError as error:
            raise OutsideError(f"cannot open a pseudo-terminal ({error})") from None
        # Held open here as well: without a listener reads on our side would be errors.
        tty.setraw(self._theirs)
        os.set_blocking(self._ours, False)
        self._board = board
        self._unsent = b""
        self._link: Path | None = None
        self.path = Path(os.ttyname(self._theirs))
        """Its name: `serial://` and this is its address."""
        if link is not None:
            try:
                self._make(link)
            except BaseException:
                self.close()
                raise

    def _make(self, link: Path) -> None:
        if link.exists() and not (link.is_symlink() and link.is_char_device()):
            raise InputError(f"{link} is a file; give another name for the terminal")
        try:
            link.unlink(missing_ok=True)
            link.symlink_to(self.path)
        except OSError as error:
            raise OutsideError(
                f"cannot make the link {link} ({error.strerror}); give a name in another folder"
            ) from None
        self._link = link

    def __enter__(self) -> "Terminal":
        """Return itself; it is closed at the end."""
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def advance(self, now: float) -> None:
        """Carry bytes both ways; call it about once per period of the board.

        Args:
            now: The time [s].
        """
        with contextlib.suppress(BlockingIOError):
            self._board.feed(os.read(self._ours, CHUNK))
        said = self._board.advance(now)
        # A line that has begun is finished first; whole ones are lost while no one reads.
        self._unsent = self._write(self._unsent)
        if not self._unsent:
            self._unsent = self._write(said, b"")

    def _write(self, data: bytes, otherwise: bytes | None = None) -> bytes:
        """Write what fits, and return the rest; `otherwise` where nothing does."""
        try:
            return data[os.write(self._ours, data) :]
        except BlockingIOError:
            return data if otherwise is None else otherwise

    def close(self) -> None:
        """Close the terminal and take the link away; may be called again.

        A link that leads elsewhere by now is another emulation's.
        """
        with contextlib.suppress(OSError):
            if self._link is not None and self._link.readlink() == self.path:
                self._link.unlink()
        self._link = None
        for number in (self._ours, self._theirs):
            if number >= 0:
                os.close(number)
        self._ours = self._theirs = -1
