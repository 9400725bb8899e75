"""Draw the pictures of README and documents with the shipped policy: `make pictures`.

balancing.webp shows one run on the digital twin, as `equipoise log export RUN --video
balancing.webp --from 0 --to 8` films it; survival.png the policy and the baselines on the
training plant; map.png the starts that the policy holds there. With `--all` also gap.png and
compare.png, whose trainings and trials take an hour on two cores.
"""

import argparse
import subprocess
import sys
from pathlib import Path

import equipoise as eq
from equipoise.apps.report.figures import survival
from equipoise.apps.style import render
from equipoise.film import write_film

HERE = Path(__file__).parent
EXPERIMENTS = {"map": (), "gap": (), "compare": ("--told",)}
"""Experiments that draw a picture, with their options."""


def main() -> None:
    """Draw the pictures."""
    parser = argparse.ArgumentParser(description="Draw the pictures of README and documents.")
    parser.add_argument("--all", action="store_true", help="gap.png and compare.png, too")
    given = parser.parse_args()
    policy = eq.shipped_policy()
    run = eq.simulate_run(policy, world="twin:nominal", duration=10.0)
    write_film(run, HERE / "balancing.webp", begin=0.0, end=8.0)
    (HERE / "survival.png").write_bytes(render(survival(eq.evaluate(policy)), "png"))
    for name in EXPERIMENTS if given.all else ("map",):
        script, out = HERE.parents[1] / "experiments" / f"{name}.py", HERE / f"{name}.png"
        command = [sys.executable, script, *EXPERIMENTS[name], "--out", out]
        subprocess.run(command, check=True)


if __name__ == "__main__":
    main()
