"""Runs on the emulated rig in real time: how long they last, and how punctual they are.

`equipoise rig emulate` runs in one process, over TCP and a pseudo-terminal. `equipoise deploy` runs
in another, once for each run; this script types the answers of an operator::

    python benchmarks/rig.py --runs 20 --duration 60 --out runs
    python benchmarks/rig.py --runs 1 --duration 600 --out runs

A line of JSON for each run, and one for all. Every run counts; `stalls` says how often the machine
stood still meanwhile for more than 20 ms, as the emulator saw it.
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

from equipoise.studies.rehearsal.real_time import ANSWERS

STALL = "the host stalled"
EQUIPOISE = (sys.executable, "-u", "-m", "equipoise")


def main() -> None:
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("policy", nargs="?", default=None, help="without it, the shipped one")
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--duration", type=float, default=60.0)
    parser.add_argument("--world", default="twin:nominal")
    parser.add_argument("--port", type=int, default=30001)
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    lasted = 0
    with tempfile.TemporaryDirectory() as folder:
        link = Path(folder) / "encoder"
        for number in range(given.runs):
            said: list[str] = []
            rig = subprocess.Popen(
                [
                    *(*EQUIPOISE, "rig", "emulate", "--world", given.world, "--seed", str(number)),
                    *("--port", str(given.port), "--encoder-link", str(link)),
                ],
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
            )
            threading.Thread(target=_listen, args=(rig, said), daemon=True).start()
            try:
                while not link.exists():
                    if rig.poll() is not None:
                        sys.exit("\n".join(said))
                    time.sleep(0.1)
                before = sum(STALL in line for line in said)
                outcome = _deploy(given, link, given.out / f"run-{number}.mcap")
                outcome["stalls"] = sum(STALL in line for line in said) - before
            finally:
                rig.send_signal(signal.SIGINT)
                rig.wait()
            lasted += outcome.get("cause") == "lasted"
            print(json.dumps({"number": number, **outcome}), flush=True)
    print(json.dumps({"world": given.world, "runs": given.runs, "lasted": lasted}))


def _deploy(given: argparse.Namespace, link: Path, log: Path) -> dict[str, object]:
    """Run once, typing the answers; return what came of it."""
    process = subprocess.Popen(
        [
            *(*EQUIPOISE, "deploy", *([given.policy] if given.policy else [])),
            *("--robot", f"kst://127.0.0.1:{given.port}", "--encoder", f"serial://{link}"),
            *("--duration", str(given.duration), "--out", str(log), "--json"),
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
    reader = threading.Thread(target=lambda: result.append(process.stdout.read()))  # type: ignore[union-attr]
    reader.start()
    last = ""
    for line in process.stderr:
        last = line.strip() or last
        for pattern, answer in ANSWERS:
            if asked := pattern.search(line):
                process.stdin.write((answer or asked.group(1)) + "\n")
                process.stdin.flush()
    code = process.wait()
    reader.join()
    try:
        return {"code": code, **json.loads(result[0])}
    except json.JSONDecodeError:
        return {"code": code, "error": last}


def _listen(process: subprocess.Popen[str], said: list[str]) -> None:
    for line in process.stdout or ():
        said.append(line.rstrip())


if __name__ == "__main__":
    main()
