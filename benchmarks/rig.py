"""Runs on the emulated rig in real time: how long they last, and how punctual they are.

`equipoise rig emulate` runs in one process, over TCP and a pseudo-terminal. `equipoise deploy` runs
in another, once for each run; this script types the answers of an operator::

    python benchmarks/rig.py --runs 20 --duration 60 --out runs
    python benchmarks/rig.py --runs 1 --duration 600 --out runs
    python benchmarks/rig.py --runs 10 --duration 30 --console client --out runs
    python benchmarks/rig.py policy.json --robot franka --arm fr3 --runs 10 --out runs

With `--console` each run is made twice, without and with the console, in alternating order. A
`client` receives all that the console sends to a browser on another computer; a `browser` is
Chromium on this one, which draws the scene.

A line of JSON for each run, and one for all. Every run counts; `stalls` says how often the machine
stood still meanwhile for more than 20 ms, as the emulator saw it.

Lateness is given twice: of all ticks, and of the ticks during which the machine ran. A witness of
the highest priority sleeps a millisecond at a time on the core of the loop; where it wakes more
than half a millisecond late, no process of this computer is the cause.
"""

import argparse
import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from equipoise.log.run_log import RunLog

ANSWERS = ((re.compile(r"Type (\w+)\."), None), (re.compile(r"y or n"), "y"))
"""Pattern of each prompt, and its answer; None if the first group of the match is the answer."""
HAND = (
    ("button", "press"),
    ("Lift the pendulum", "lift"),
    ("Armed", "release"),
    ("nudge it", "push"),  # dry friction may hold a pendulum that was released upright
)
"""Prompts, and the words that make the emulated hand follow them."""
STALL = "the host stalled"
ATTEMPTS = 4
"""Starts of a run that is compared, where the link is refused before anything moves."""
KINDS = ("all_ticks", "machine_ran")
RESAMPLES = 1000
"""Number of bootstrap samples of the runs, for the 95 % interval of a ratio."""
CONSOLE = re.compile(r"http://127\.0\.0\.1:\d+/\?token=\S+")
EQUIPOISE = (sys.executable, "-u", "-m", "equipoise")


def main() -> None:
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("policy", nargs="?", default=None, help="without it, the shipped one")
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--duration", type=float, default=60.0)
    parser.add_argument("--world", default="twin:nominal")
    parser.add_argument("--robot", default="kst")
    parser.add_argument("--arm", default="iiwa7")
    parser.add_argument("--console", choices=("client", "browser"), help="who watches")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--json", type=Path, help="file of the results")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    args.lateness = {kind: {False: [], True: []} for kind in KINDS}
    runs = survived = 0
    for number in range(args.runs):
        both = (number % 2 == 1, number % 2 == 0) if args.console else (False,)
        for console in both:
            for _ in range(ATTEMPTS if args.console else 1):
                outcome = _run(args, number, console)
                runs, survived = runs + 1, survived + (outcome.get("outcome") == "survived")
                print(json.dumps({"number": number, "console": console, **outcome}), flush=True)
                if KINDS[0] in outcome:
                    break
    total = {"world": args.world, "runs": runs, "survived": survived}
    compared = args.console and all(args.lateness[KINDS[0]].values())
    rng = np.random.default_rng(0)
    for kind in KINDS if compared else ():
        late = args.lateness[kind]
        without, beside = (_p999(np.concatenate(late[console])) for console in (False, True))
        ratios: list[float] = []
        for _ in range(RESAMPLES):
            drawn = [rng.integers(len(late[k]), size=len(late[k])) for k in (False, True)]
            ones = [_p999(np.concatenate([late[k][i] for i in drawn[k]])) for k in (False, True)]
            ratios.append(ones[1] / ones[0])
        total[kind] = {
            "p999_ms": {"without": 1e3 * without, "with": 1e3 * beside},
            "ratio": beside / without,
            "interval": np.quantile(ratios, (0.025, 0.975)).tolist(),
        }
    print(json.dumps(total))
    if args.json:
        args.json.write_text(json.dumps(total))


def _p999(late: np.ndarray) -> float:
    return float(np.quantile(late, 0.999))


def _run(args: argparse.Namespace, number: int, console: bool) -> dict[str, object]:
    """Make one run on a rig of its own; return what came of it."""
    lines: list[str] = []
    log = args.out / f"run-{number}{'-console' if console else ''}.mcap"
    with tempfile.TemporaryDirectory() as folder:
        link = Path(folder) / "encoder"
        rig = subprocess.Popen(
            [
                *(*EQUIPOISE, "rig", "emulate", "--world", args.world, "--seed", str(number)),
                *("--robot", args.robot, "--arm", args.arm, "--encoder-link", str(link)),
            ],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        threading.Thread(target=_listen, args=(rig, lines), daemon=True).start()
        try:
            while not link.exists():
                if rig.poll() is not None:
                    sys.exit("\n".join(lines))
                time.sleep(0.1)
            before = sum(STALL in line for line in lines)
            with _witness(Path(folder) / "gaps") as gaps:
                outcome = _deploy(args, link, log, console, rig)
            outcome["stalls"] = sum(STALL in line for line in lines) - before
        finally:
            rig.send_signal(signal.SIGINT)
            rig.wait()
    if not log.exists():
        return outcome
    if len(tick := RunLog.load(log, damaged=True).tables["tick"]):
        late = np.maximum(tick["late"], 0.0)
        stood = _stood_still(tick["time"] - late, tick["time"], np.array(gaps).reshape(-1, 2))
        for kind, ticks in zip(KINDS, (late, late[~stood]), strict=True):
            args.lateness[kind][console].append(ticks)
            outcome[kind] = {"ticks": len(ticks), "p999_ms": 1e3 * _p999(ticks)}
    elif args.console:
        log.unlink()
    return outcome


@contextlib.contextmanager
def _witness(path: Path) -> Iterator[list[list[float]]]:
    """Run the witness; give the list of its gaps, begin and end [s], which is full afterwards."""
    gaps: list[list[float]] = []
    with path.open("w", encoding="ascii") as written:
        witness = subprocess.Popen([sys.executable, "-c", WITNESS], stdout=written)
    try:
        yield gaps
    finally:
        witness.terminate()
        witness.wait()
        gaps += [[float(word) for word in line.split()] for line in path.read_text().splitlines()]


def _stood_still(due: np.ndarray, begun: np.ndarray, gaps: np.ndarray) -> np.ndarray:
    """Return whether a gap began before the start of each tick and ended after it was due."""
    inside = (gaps[:, 0] < begun[:, None]) & (gaps[:, 1] > due[:, None])
    return np.asarray(inside.any(axis=1))


WITNESS = """
import os, time
os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(os.sched_get_priority_max(os.SCHED_FIFO)))
os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
last = time.monotonic()
while True:
    time.sleep(1e-3)
    now = time.monotonic()
    if now - last > 1.5e-3:
        print(last, now, flush=True)
    last = now
"""


def _open_in_a_browser(address: str, folder: str) -> "subprocess.Popen[bytes]":
    """Open a page in Chromium without a screen, on the first core, behind everything else."""

    def aside() -> None:
        os.nice(15)
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})

    chromium = shutil.which("chromium")
    if chromium is None:
        sys.exit("there is no Chromium to open the console in; install chromium")
    arguments = ("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--use-gl=angle")
    software = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--window-size=640,480")
    return subprocess.Popen(
        [chromium, *arguments, *software, f"--user-data-dir={folder}", address],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        preexec_fn=aside,
    )


def _receive(address: str, _: str) -> "subprocess.Popen[bytes]":
    """Connect to a console as a page does, in a process of its own, and receive what it sends."""
    return subprocess.Popen([sys.executable, "-c", CLIENT, address])


CLIENT = """
import http.client, os, signal, sys, urllib.parse
import viser
from websockets.sync.client import connect

os.nice(15)
os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
parts = urllib.parse.urlsplit(sys.argv[1])
server = http.client.HTTPConnection(parts.netloc)
server.request("GET", "/?" + parts.query)
cookie = server.getresponse().getheader("Set-Cookie").partition(";")[0]
page = connect(
    "ws://" + parts.netloc,
    origin="http://" + parts.netloc,
    additional_headers={"Cookie": cookie},
    subprotocols=["viser-v" + viser.__version__],
    max_size=None,
)
received = 0
try:
    for message in page:
        received += len(message)
finally:
    print(f"received {received / 1e6:.1f} MB", file=sys.stderr)
"""
WATCHERS = {"client": _receive, "browser": _open_in_a_browser}


def _deploy(
    args: argparse.Namespace,
    link: Path,
    log: Path,
    console: bool,
    rig: "subprocess.Popen[str]",
) -> dict[str, object]:
    """Run once, typing the answers and moving the emulated hand; return what came of it."""
    process = subprocess.Popen(
        [
            *(*EQUIPOISE, "deploy", *([args.policy] if args.policy else [])),
            *("--robot", f"{args.robot}://127.0.0.1", "--encoder", f"serial://{link}"),
            *("--arm", args.arm, "--duration", str(args.duration), "--out", str(log), "--json"),
        ],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"COLUMNS": "400"},  # a question that is cut into two lines has no answer
    )
    if process.stdin is None or process.stdout is None or process.stderr is None:
        raise RuntimeError("a process without pipes")
    result: list[str] = []
    profile = tempfile.mkdtemp()
    watchers: list[subprocess.Popen[str] | subprocess.Popen[bytes]] = []
    if console:
        watchers.append(
            subprocess.Popen([*EQUIPOISE, "console"], stdout=subprocess.PIPE, text=True)
        )
        page = CONSOLE.search(watchers[0].stdout.readline())  # type: ignore[union-attr]
        watchers.append(WATCHERS[args.console](page[0], profile))  # type: ignore[index]
    reader = threading.Thread(target=lambda: result.append(process.stdout.read()))  # type: ignore[union-attr]
    reader.start()
    last = ""
    for line in process.stderr:
        last = line.strip() or last
        for pattern, answer in ANSWERS:
            if asked := pattern.search(line):
                process.stdin.write((answer or asked.group(1)) + "\n")
                process.stdin.flush()
        for prompt, act in HAND:
            if prompt in line and rig.stdin is not None:
                rig.stdin.write(act + "\n")
                rig.stdin.flush()
    code = process.wait()
    reader.join()
    for watcher in watchers:
        watcher.terminate()
        watcher.wait()
    shutil.rmtree(profile, ignore_errors=True)
    try:
        return {"code": code, **json.loads(result[0])}
    except json.JSONDecodeError:
        return {"code": code, "error": last}


def _listen(process: subprocess.Popen[str], lines: list[str]) -> None:
    for line in process.stdout or ():
        lines.append(line.rstrip())


if __name__ == "__main__":
    main()
