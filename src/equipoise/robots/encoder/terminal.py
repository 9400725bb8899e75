"""Emulated board on a pseudo-terminal, a serial port without a cable.

To a client it looks like a board on USB. Linux and macOS only.
"""

import contextlib
import os
import sys
from pathlib import Path
from typing import Final

from equipoise.errors import InputError, OutsideError
from equipoise.robots.encoder.board import Board

CHUNK: Final = 4096
"""Maximum number of bytes per read."""


class Terminal:
    """Pseudo-terminal with a board behind it."""

    def __init__(self, board: Board, link: Path | None = None) -> None:
        """Open the terminal.

        Args:
            board: The board; its lines are dropped while no client reads, as those of a real board.
            link: Second name, as a symbolic link; replaces a link to another terminal and a broken
                link.

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
        # The client's side stays open here: without a client, reads on our side would fail.
        tty.setraw(self._theirs)
        os.set_blocking(self._ours, False)
        self._board = board
        self._unsent = b""
        self._link: Path | None = None
        self.path = Path(os.ttyname(self._theirs))
        """Name of the terminal; its address is `serial://` with this name."""
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

    def advance(self, now: float) -> None:
        """Transfer bytes both ways; call it about once per period of the board.

        Args:
            now: The time [s].
        """
        with contextlib.suppress(BlockingIOError):
            self._board.feed(os.read(self._ours, CHUNK))
        sent = self._board.advance(now)
        # A partly written line is finished first; whole lines are lost while no client reads.
        with contextlib.suppress(BlockingIOError):
            self._unsent = self._unsent[os.write(self._ours, self._unsent) :]
            if not self._unsent:
                self._unsent = sent[os.write(self._ours, sent) :]

    def close(self) -> None:
        """Close the terminal and remove the link; may be called again.

        A link that leads elsewhere by now belongs to another emulation, and stays.
        """
        with contextlib.suppress(OSError):
            if self._link is not None and self._link.readlink() == self.path:
                self._link.unlink()
        self._link = None
        for number in (self._ours, self._theirs):
            if number >= 0:
                os.close(number)
        self._ours = self._theirs = -1
