"""Programs of Equipoise beside the tests, and the lines that they print."""

import contextlib
import os
import re
import signal
import subprocess
import sys
import threading
import time

LONGEST = 90.0  # a first start compiles [s]


def wait_until(condition, what, limit=LONGEST):
    """Wait until a condition holds, and return its value."""
    end = time.monotonic() + limit
    while not (value := condition()):
        assert time.monotonic() < end, f"no {what} within {limit:g} s"
        time.sleep(0.05)
    return value


def run_program(*words, check=True, **options):
    """Run a program to its end; return its exit code, its output and its errors."""
    words = [str(word) for word in words]
    return subprocess.run(words, capture_output=True, text=True, check=check, **options)


def start_program(*words, **options):
    """Start a program whose output and errors are read at its end."""
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return subprocess.Popen(words, text=True, **pipes, **options)


class Program:
    """A program of Equipoise, and the lines that it prints."""

    def __init__(self, *words):
        command = [sys.executable, "-u", "-m", "equipoise", *words]
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
        wide = os.environ | {"COLUMNS": "400"}
        self.process = subprocess.Popen(command, text=True, env=wide, **pipes)
        self.lines = []
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self):
        for line in self.process.stdout:
            self.lines.append(line.rstrip())

    def find(self, pattern, limit=LONGEST):
        """Wait for a line with a pattern, and return the match."""

        def found():
            matches = (re.search(pattern, line) for line in list(self.lines))
            match = next(filter(None, matches), None)
            assert match or self.process.poll() is None, "\n".join(self.lines)
            return match

        return wait_until(found, f"line with {pattern}", limit)

    def end(self):
        self.process.send_signal(signal.SIGINT)
        return self.process.wait(20.0)


@contextlib.contextmanager
def program(*words):
    started = Program(*words)
    try:
        yield started
    finally:
        started.process.terminate()
        try:
            started.process.wait(10.0)
        except subprocess.TimeoutExpired:
            started.process.kill()
        started.process.stdin.close()
