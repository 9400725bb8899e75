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

    def __init__(self, board: Board) -> None:
        """Open the terminal.

        Args:
            board: The board; its lines are dropped while no client reads, as those of a real board.

        Raises:
            OutsideError: There are no pseudo-terminals here.
        """
        try:
            import pty
            import tty

            self._ours, self._theirs = pty.openpty()
        except (ImportError, OSError) as error:
            raise OutsideError(
                f"{sys.platform} has no pseudo-terminal for the board ({error}); use Linux or macOS"
            ) from None
        # The client's side stays open here: without a client, reads on our side would fail.
        tty.setraw(self._theirs)
        os.set_blocking(self._ours, False)
        self._board, self._unsent = board, b""
        self._link: Path | None = None
        self.path = Path(os.ttyname(self._theirs))
        """Name of the terminal; its address is `serial://` with this name."""

    def link(self, name: Path) -> None:
        """Give the terminal a second name, as a symbolic link; replace another symbolic link.

        Raises:
            InputError: A file has that name.
        """
        if name.exists() and not name.is_symlink():
            raise InputError(f"{name} is a file; give another name for the terminal")
        name.unlink(missing_ok=True)
        name.symlink_to(self.path)
        self._link = name

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
        """Close the terminal, and remove its second name; may be called again."""
        if self._link is not None:
            self._link.unlink(missing_ok=True)
            self._link = None
        for number in (self._ours, self._theirs):
            if number >= 0:
                os.close(number)
        self._ours = self._theirs = -1
