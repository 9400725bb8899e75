"""Identify the actuator of every named twin, and count the intervals that hold.

Each log is ten seconds of motion about home, with a seed of its own. Delay and t_c are compared
with those of the twin's servo; the lags are those of the loaded joints, which nothing else gives::

    python experiments/identification.py --logs 10
"""

import json

import numpy as np
from shared import options, proportion, store

import equipoise as eq
from equipoise.model.worlds import WORLDS
from equipoise.simulation.twin.servo_model import equivalent_actuator

KUKA = list(WORLDS)
"""Worlds of the default arm."""


def main() -> None:
    """Identify all logs, and print a row for each world."""
    parser = options(__doc__, "json")
    parser.add_argument("--worlds", nargs="+", default=KUKA)
    parser.add_argument("--logs", type=int, default=10, help="number of logs of each world")
    args = parser.parse_args()
    rows: list[dict] = []
    covered: list[bool] = []
    for world in args.worlds:
        true = equivalent_actuator(eq.read_world(f"twin:{world}").settings)
        logs = [eq.excite("iiwa7", f"twin:{world}", seed=seed) for seed in range(args.logs)]
        actuators = [eq.identify_run(log) for log in logs]
        row: dict = {"name": world}
        for name in ("cycle", "delay"):
            estimates = [getattr(actuator, name) for actuator in actuators]
            value = getattr(true, name).value
            covered += [one.low <= value <= one.high for one in estimates]
            fitted = 1e3 * np.array([one.value for one in estimates])
            row[name] = {"true": 1e3 * value, "mean": fitted.mean(), "sd": fitted.std()}
        lags = 1e3 * np.mean(
            [[lag.value for lag in actuator.lags] for actuator in actuators], axis=0
        )
        row["lags"] = [lags.min(), lags.max()]
        rows.append(row)
        print(json.dumps(row), flush=True)
    print(f"intervals that hold: {sum(covered)} of {len(covered)}")
    intervals = proportion(sum(covered), len(covered))
    store(args.json, {"logs": args.logs, "worlds_ms": rows, "intervals": intervals})


if __name__ == "__main__":
    main()
