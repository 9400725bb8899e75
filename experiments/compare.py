"""Compare policies: learned tables, searched and solved ones, baselines, and policies of others.

Each row is a policy, each column a world. All rows run the same trials: start, plant and noise of
trial i depend on the seed and i alone. Every algorithm has the same episodes, one training and the
settings of its recipe; nothing is chosen for a row. Value iteration and the search for the best
table are no algorithms but bounds. Every controller assumes the actuator of the training; with
`--known` a further column of each twin has the twin's own actuator::

    python experiments/compare.py --known --out compare.png                 # half an hour
    python experiments/compare.py network.onnx my_module:my_function --rows robust lqr
"""

import sys
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from shared import options, store
from table_search import search_table
from value_iteration import solve_table

import equipoise as eq
from equipoise.control.policy import TaskPolicy, tick_policy
from equipoise.executors import available_cores
from equipoise.settings import changed
from equipoise.simulation.evaluation import Summary
from equipoise.simulation.twin.servo_model import equivalent_actuator

sys.path.append(str(Path(__file__).parents[1] / "examples" / "algorithms"))

TRAINED = {
    "paper": ("paper",),
    "robust": ("robust",),
    "expected-sarsa": ("robust", "learning.algorithm=expected_sarsa:algorithm"),
    "watkins": ("robust", "learning.algorithm=watkins:algorithm"),
    "double-q": ("robust", "learning.algorithm=double_q:algorithm"),
    "fine": ("fine",),
}
"""Recipe and settings of each row that is trained."""
BOUNDS = {"value-iteration": "robust", "best-table": "robust", "best-fine": "fine"}
"""Row whose task and table each bound takes up."""
BASELINES = ("lqr", "lqr-snapped", "pd", "random")
ROWS = (*TRAINED, *BOUNDS, *BASELINES)
WORLDS = ("ideal", "model", "twin:nominal", "twin:harsh")
QUICK = {
    "value-iteration": {"rounds": 2, "loops": 64, "ticks": 300},
    "best-table": {"generations": 3, "tables": 16},
    "best-fine": {"generations": 3, "tables": 16},
}
"""Effort of the bounds in the quick form."""
COLOURS = {
    "trained": "tab:blue",
    "bound": "tab:purple",
    "baseline": "tab:green",
    "given": "tab:red",
}
STORED = ("survived", "trials", "interval", "median")
"""Fields of a summary in the file of results."""
RUNS = 3
"""Number of runs on `model` for the root mean square of x."""


class Row(NamedTuple):
    """A policy of the comparison."""

    policy: TaskPolicy
    """The policy."""
    kind: str
    """Key of `COLOURS`."""
    wall: float = 0.0
    """Time of training, solution or search [s]."""


def made_rows(names: list[str], args: list[str], settings: list[str], quick: bool) -> dict:
    """Train, solve, search or load all policies; return the rows by name."""
    workers, tables = available_cores(), dict[str, eq.TabularPolicy]()
    pendulum, arm = eq.shipped_pendulum(), eq.iiwa(7)

    def learned(name: str) -> eq.TabularPolicy:
        if name not in tables:
            recipe, *changes = TRAINED[name]
            resolved = eq.resolve(recipe, overrides=[*changes, *settings])
            tables[name] = eq.train(pendulum, arm, resolved, workers=workers)
        return tables[name]

    rows: dict[str, Row] = {}
    for name in names:
        begin, size = time.perf_counter(), QUICK.get(name, {}) if quick else {}
        if name in TRAINED:
            policy, kind = learned(name), "trained"
        elif name in BASELINES:
            policy, kind = eq.load_policy(name), "baseline"
        elif name == "value-iteration":
            policy = solve_table(learned(BOUNDS[name]), workers=workers, **size)
            kind = "bound"
        else:
            task, kind = learned(BOUNDS[name]), "bound"
            starts = [
                table.u_of_box
                for table in tables.values()
                if table.settings.boxes == task.settings.boxes
            ]
            policy = search_table(task, starts, workers=workers, **size)
        rows[name] = Row(policy, kind, time.perf_counter() - begin)
        print(f"{name}: made in {rows[name].wall:.0f} s", flush=True)
    return rows | {name: Row(eq.load_policy(name), "given") for name in args}


def columns_of(worlds: list[str], known: bool) -> list[tuple[str, str, eq.Actuator | None]]:
    """Return title, world and actuator of each column; None for that of the training."""
    columns: list[tuple[str, str, eq.Actuator | None]] = []
    for world in worlds:
        columns.append((world, world, None))
        if known and world.startswith("twin:"):
            actuator = equivalent_actuator(eq.read_world(world).settings)
            columns.append((f"{world}, known", world, actuator))
    return columns


def survival(
    policy: TaskPolicy, world: str, known: eq.Actuator | None, trials: int, duration: float
) -> Summary:
    """Return the trials of a policy in a world; trial i has the same start for every policy."""
    length = {"evaluation.trials": trials, "evaluation.duration": duration}
    settings = changed(policy.settings, length)
    if policy.actuator.kind == "ideal":
        known = None  # the controller of the paper assumes an ideal arm everywhere
    args = {"with_baselines": False, "workers": available_cores()}
    return eq.evaluate(policy, settings, world=world, actuator=known, **args).results.summary()


def rms_x(policy: TaskPolicy, duration: float) -> float:
    """Return the root mean square of x over some runs on `model` [m]."""
    runs = [eq.simulate_run(policy, seed=seed, duration=duration).ticks.x for seed in range(RUNS)]
    return float(np.sqrt(np.mean(np.concatenate(runs) ** 2)))


def decision_time(policy: TaskPolicy) -> float:
    """Return the median time of a decision, called from Python as in a run [s]."""
    decide = tick_policy(policy)
    decide.reset()
    times: list[float] = []
    for state in np.random.default_rng(0).uniform(-0.05, 0.05, (1000, 4)):
        begin = time.perf_counter()
        decide.act(state)
        times.append(time.perf_counter() - begin)
    return float(np.median(times))


def draw(
    rows: dict[str, Row], titles: list[str], summaries: dict[tuple[str, str], Summary]
) -> Figure:
    """Draw the fraction of the trials that survived, with its 95 % interval."""
    figure = Figure(figsize=(10.0, 1.5 + 0.25 * len(rows)), layout="constrained")
    panels = figure.subplots(1, len(titles), sharey=True, squeeze=False)[0]
    for panel, title in zip(panels, titles, strict=True):
        for place, (name, row) in enumerate(rows.items()):
            summary = summaries[name, title]
            low, high = summary.interval
            arms = 100.0 * np.array([[summary.rate - low], [high - summary.rate]])
            look = {"fmt": "o", "color": COLOURS[row.kind], "capsize": 2, "markersize": 4}
            panel.errorbar([100.0 * summary.rate], [place], xerr=np.maximum(arms, 0.0), **look)
        panel.set_title(title.replace(", ", "\n"), fontsize=9)
        panel.set(xlim=(-3, 103), xticks=[0, 50, 100], xlabel="survived [%]")
    panels[0].set_yticks(range(len(rows)), [name.rpartition("/")[2] for name in rows])
    panels[0].invert_yaxis()
    return figure


def main() -> None:
    """Make all policies, run them in all worlds, print the table, and draw the figure."""
    parser = options(__doc__, "set", "json", trials=100, duration=60.0, out="compare.png")
    parser.add_argument("policies", nargs="*", help="files, ONNX networks, or MODULE:NAME")
    parser.add_argument("--rows", nargs="*", choices=ROWS, default=list(ROWS))
    parser.add_argument("--worlds", nargs="+", default=list(WORLDS))
    parser.add_argument("--known", action="store_true", help="twins also with their own actuator")
    parser.add_argument("--quick", action="store_true", help="short searches")
    args = parser.parse_args()
    rows = made_rows(args.rows, args.policies, args.set, args.quick)
    columns = columns_of(args.worlds, args.known)
    summaries = {
        (name, title): survival(row.policy, world, known, args.trials, args.duration)
        for name, row in rows.items()
        for title, world, known in columns
    }
    titles = [title for title, _, _ in columns]
    print(f"\n| row | {' | '.join(titles)} | rms x [mm] | made in | a decision |")
    print("| --- " * (len(titles) + 4) + "|")
    made: list[dict] = []
    for name, row in rows.items():
        cells = [
            f"{summaries[name, t].rate:.0%} ({summaries[name, t].median:.1f} s)" for t in titles
        ]
        rms_mm = 1e3 * rms_x(row.policy, args.duration)
        cells.append(f"{rms_mm:.1f}")
        made.append({"name": Path(name).stem, "rms_x_mm": rms_mm})
        for title in titles:
            key = title.removeprefix("twin:").replace(", ", "_")
            made[-1][key] = {field: getattr(summaries[name, title], field) for field in STORED}
        cells += [f"{row.wall:.0f} s", f"{1e6 * decision_time(row.policy):.1f} us"]
        print(f"| {name} | {' | '.join(cells)} |", flush=True)
    draw(rows, titles, summaries).savefig(args.out, dpi=150)
    about = {"trials": args.trials, "duration": args.duration, "seed": 0}
    store(args.json, about | {"rows": made})


if __name__ == "__main__":
    main()
