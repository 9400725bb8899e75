"""Pseudo-terminal with an emulated encoder board behind it, in real time."""

import os
import sys
from contextlib import suppress
from pathlib import Path

from equipoise.errors import InputError, OutsideError
from equipoise.rig.transports import CHUNK
from equipoise.robots.encoder.board import Board


class Terminal:
    """Pseudo-terminal with an emulated board behind it; to a client a board on USB."""

    def __init__(self, board: Board, link: Path | None = None) -> None:
        """Open the terminal.

        Args:
            board: The board; its lines are dropped while no client reads, as those of a real board.
            link: Second name of the terminal, a symbolic link; replaces another symbolic link.

        Raises:
            InputError: A file has that name.
            OutsideError: There are no pseudo-terminals here.
        """
        if link is not None and link.exists() and not link.is_symlink():
            raise InputError(f"{link} is a file; give another name for the terminal")
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
        self._board, self._unsent, self._link = board, b"", link
        self.path = Path(os.ttyname(self._theirs))
        """Name of the terminal; its address is `serial://` with this name."""
        if link is not None:
            link.unlink(missing_ok=True)
            link.symlink_to(self.path)

    def advance(self, now: float) -> None:
        """Transfer bytes both ways; call it about once per period of the board.

        Args:
            now: The time [s].
        """
        with suppress(BlockingIOError):
            self._board.feed(os.read(self._ours, CHUNK))
        sent = self._board.advance(now)
        # A partly written line is finished first; whole lines are lost while no client reads.
        with suppress(BlockingIOError):
            self._unsent = self._unsent[os.write(self._ours, self._unsent) :]
            if not self._unsent:
                self._unsent = sent[os.write(self._ours, sent) :]

    def close(self) -> None:
        """Close the terminal, and remove its second name."""
        if self._link is not None:
            self._link.unlink(missing_ok=True)
        os.close(self._ours)
        os.close(self._theirs)
