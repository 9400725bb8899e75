"""Survival on the twin of the designed rig: python hardware/evaluate.py --out FOLDER --json FILE.

The response of the twin's arm is identified from ten seconds of motion, and a policy trained behind
it for each seed. All are evaluated from a hand's release, from hanging, and with a constant error
of the zero: a periodic error of the encoder changes little within the policy's 11 degrees, but may
differ between hanging, where the zero is taken, and upright, by twice its amplitude at most. Needs
the program alone, nothing of requirements.txt.
"""

import argparse
import json
from math import radians
from pathlib import Path

from equipoise.control.policy import TabularPolicy
from equipoise.executors import available_cores
from equipoise.identification.actuator import identify_run
from equipoise.learning.train import train_to_target
from equipoise.model.pendulum import shipped_pendulum
from equipoise.model.worlds import World, read_world
from equipoise.rig.config import read_rig
from equipoise.rig.simulate import excite
from equipoise.settings import resolve
from equipoise.simulation.evaluation import evaluate

FOLDER = Path(__file__).resolve().parent
CASES = {
    "hand": ("hand", 0.0),
    "hanging": ("hanging", 0.0),
    "accuracy": ("hand", 0.25),
    "twice": ("hand", 0.5),
}
"""Start of the trials, and error of the zero [deg]; the AMT102 is accurate to 0.25 deg."""


def main() -> None:
    """Train and evaluate as the command line asks."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--trials", type=int, default=50)
    parser.add_argument("--duration", type=float, default=60.0)
    parser.add_argument("--out", type=Path, required=True, help="policies, used again if there")
    parser.add_argument("--json", type=Path, required=True)
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    arm = read_rig(FOLDER / "rig-iiwa7.toml").described_arm
    world = read_world(f"twin:{FOLDER / 'twin.toml'}")
    pendulum, cores = shipped_pendulum(), available_cores()
    actuator = identify_run(excite(arm, world.name, pendulum, seed=0))
    found = {case: {"survived": 0, "trials": 0, "worst": args.trials} for case in CASES}
    for seed in range(args.seeds):
        file = args.out / f"policy-{seed}.json"
        if not file.exists():
            policy = train_to_target(pendulum, arm, actuator=actuator, seed=seed, workers=cores)
            policy.save(file, command="train", inputs={"actuator": actuator.digest})
        policy = TabularPolicy.load(file)
        for case, (start, error) in CASES.items():
            settings = resolve(
                overrides=[
                    f"evaluation.trials={args.trials}",
                    f"evaluation.duration={args.duration}",
                    f"evaluation.start={start}",
                ]
            )
            off = world.settings.model_copy(update={"zero_offset": radians(error)})
            results = evaluate(
                policy,
                settings,
                world=World(world.name, off),
                seed=seed,
                with_baselines=False,
                workers=cores,
            )
            survived = results.results.summary().survived
            total = found[case]
            total["survived"] += survived
            total["trials"] += args.trials
            total["worst"] = min(total["worst"], survived)
            print(json.dumps({"seed": seed, "case": case, "survived": survived}), flush=True)
    args.json.write_text(json.dumps(found))


if __name__ == "__main__":
    main()
