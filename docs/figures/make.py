"""Draw the pictures of README and documents with the shipped policy: `make pictures`.

balancing.webp shows a run of `equipoise deploy --start hanging` on the digital twin, as
`equipoise log export RUN --video balancing.webp --to 3` films it, and swing-up.png its
swing-up; survival.png the policy and the baselines on the training plant. `make results` draws the
figures of the experiments.
"""

from pathlib import Path

import equipoise as eq
from equipoise.film import write_film
from equipoise.report.figures import survival, swing_up
from equipoise.report.style import render
from equipoise.settings import HANGING, changed

HERE = Path(__file__).parent


def main() -> None:
    """Draw the pictures."""
    policy = eq.shipped_policy()
    hanging = changed(policy.settings, {"evaluation.start": HANGING})
    run = eq.simulate_run(policy, world="twin:nominal", duration=10.0, settings=hanging)
    write_film(run, HERE / "balancing.webp", end=3.0)
    (HERE / "swing-up.png").write_bytes(render(swing_up(run), "png"))
    (HERE / "survival.png").write_bytes(render(survival(eq.evaluate(policy)), "png"))


if __name__ == "__main__":
    main()
