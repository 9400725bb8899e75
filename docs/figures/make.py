"""Draw the pictures of README and documents with the shipped policy: `make pictures`.

balancing.webp shows one run on the digital twin, as `equipoise log export RUN --video
balancing.webp --from 0 --to 8` films it; survival.png the policy and the baselines on the
training plant. `make results` draws the figures of the experiments.
"""

from pathlib import Path

import equipoise as eq
from equipoise.film import write_film
from equipoise.report.figures import survival
from equipoise.report.style import render

HERE = Path(__file__).parent


def main() -> None:
    """Draw the pictures."""
    policy = eq.shipped_policy()
    run = eq.simulate_run(policy, world="twin:nominal", duration=10.0)
    write_film(run, HERE / "balancing.webp", begin=0.0, end=8.0)
    (HERE / "survival.png").write_bytes(render(survival(eq.evaluate(policy)), "png"))


if __name__ == "__main__":
    main()
