"""Draw the pictures of README and documents with the shipped policy: `make pictures`.

balancing.webp shows one run on the digital twin, as `equipoise log export RUN --video
balancing.webp --from 0 --to 8` films it; survival.png the policy and the baselines on the
training plant; map.png the starts that the policy holds there. gap.png is drawn from the file of a
full gap study, which takes long to compute:

    equipoise gap POLICY --out gap.json
    python docs/figures/make.py --gap gap.json
"""

import argparse
from pathlib import Path

import equipoise as eq
from equipoise.apps.report.figures import gap_figure, recovery_figure, survival
from equipoise.apps.report.pictures import write_video
from equipoise.apps.report.style import render
from equipoise.studies.gap_results import Gap
from equipoise.studies.recovery_map import map_recovery

HERE = Path(__file__).parent


def main() -> None:
    """Draw the pictures."""
    parser = argparse.ArgumentParser(description="Draw the pictures of README and documents.")
    parser.add_argument("--gap", type=Path, help="output file of `equipoise gap`")
    options = parser.parse_args()
    policy = eq.shipped_policy()
    run = eq.simulate_run(policy, world="twin:nominal", duration=10.0)
    write_video(run, policy.arm, HERE / "balancing.webp", begin=0.0, end=8.0)
    (HERE / "survival.png").write_bytes(render(survival(eq.evaluate(policy)), "png"))
    (HERE / "map.png").write_bytes(render(recovery_figure(map_recovery(policy)), "png"))
    if options.gap:
        (HERE / "gap.png").write_bytes(render(gap_figure(Gap.load(options.gap)), "png"))


if __name__ == "__main__":
    main()
