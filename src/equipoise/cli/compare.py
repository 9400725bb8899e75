"""`equipoise compare`: one table and one figure of learned tables, baselines and other policies."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from equipoise.cli import options as opt
from equipoise.cli.destinations import choose_file, pictures
from equipoise.cli.output import Output, trial_fields, verb
from equipoise.errors import InputError

if TYPE_CHECKING:
    from equipoise.studies.compare_results import Cell, Comparison, PolicyRow
    from equipoise.studies.progress import Show

TABLES = (
    *("paper", "robust", "sarsa", "watkins", "double_q", "fine"),
    *("value-iteration", "best-table", "best-fine"),
)
"""Rows whose tables are written beside the comparison."""
BASELINES = ("lqr", "lqr-snapped", "pd", "random")
"""Rows that are built in."""
COST = ("episodes", "steps", "selection_steps", "train_s", "size", "decision_s")
"""Fields of a row in the JSON object."""


@verb
def compare(
    given: list[Path] | None = opt.argument(
        "POLICY...",
        "Further policies: tables, networks (.onnx), or Python MODULE:NAME.",
        None,
    ),
    only: str | None = opt.value(
        "ROWS",
        "Rows to make, separated by commas, or none; by default all.",
    ),
    worlds: str = opt.value(
        "WORLDS", "Worlds, separated by commas.", default="ideal,model,twin:nominal,twin:harsh"
    ),
    told: bool = opt.flag(
        "--told", "Add a column for each twin, in which controllers assume the twin's own actuator."
    ),
    pendulum: Path | None = opt.TASK_PENDULUM,
    arm: str | None = opt.TASK_ARM,
    actuator: str | None = opt.KNOWN_ACTUATOR,
    episodes: int | None = opt.value(
        "N", "Episodes of each learner; 10,000, or 1,000 with --quick.", min=1
    ),
    trials: int | None = opt.value(
        "N", "Trials of each policy in each world; 200, or 20 with --quick.", min=1
    ),
    duration: float | None = opt.value("SECONDS", "Duration of a trial; 60, or 10 with --quick."),
    quick: bool = opt.flag("--quick", "Fewer episodes and trials: a first look."),
    figure: bool = opt.flag("--figure/--no-figure", "Draw the figure too.", default=True),
    seed: int = opt.SEED,
    workers: int | None = opt.WORKERS,
    ray: str | None = opt.RAY,
    out: Path | None = opt.out("Comparison to write, figure and tables beside it.", "compare.json"),
    force: bool = opt.FORCE,
    as_json: bool = opt.JSON,
) -> None:
    """Compare learned tables, baselines and your own policies on the same trials.

    Rows: paper, robust, sarsa, watkins, double_q, fine, value-iteration,
    best-table, best-fine, lqr, lqr-snapped, pd, random. Every learner has the same episodes and one
    training; nothing is tuned for a row. The best table is searched for by
    trials. Takes a quarter of an hour on a core, and a minute with --quick.
    """
    output = Output(as_json)
    output.say("Comparing policies")
    named = [*TABLES, *BASELINES] if only is None else [] if only == "none" else _names(only)
    places = _names(worlds)
    written = [row for row in TABLES if row in named]

    def beside(path: Path) -> tuple[Path, ...]:
        return *(pictures(path) if figure else ()), *(_table(path, row) for row in written)

    destination = choose_file(
        output, out, "compare.json", pendulum, *(given or ()), force=force, beside=beside
    )

    from equipoise.apps.report.figures.compare import compare_figure
    from equipoise.apps.report.style import save
    from equipoise.settings import LONGEST_TRIAL, MAX_EPISODES, MOST_TRIALS
    from equipoise.studies import compare as study

    opt.check_range("--episodes", episodes, 1, MAX_EPISODES)
    opt.check_range("--trials", trials, 1, MOST_TRIALS)
    opt.check_range("--duration", duration, 0.01, LONGEST_TRIAL, " s")
    task: dict[str, Any] = {
        "pendulum": None if pendulum is None else opt.read_pendulum(pendulum),
        "arm": None if arm is None else opt.read_arm(arm),
        "actuator": opt.read_actuator(actuator),
    }
    policies = given or []
    study.load_given(policies, named, **task)
    total = study.trials_of(policies, named, places, told, trials, quick)
    with output.stages() as show:
        _compile(show, named, places, task["arm"], quick)
        compared = study.compare(
            policies,
            rows=named,
            worlds=places,
            told=told,
            **task,
            episodes=episodes,
            trials=trials,
            duration=duration,
            quick=quick,
            seed=seed,
            workers=opt.executor(workers, ray),
            progress=study.StageProgress(show, total),
        )
    found = compared.comparison
    inputs = {row.name: row.policy for row in found.rows}
    with destination.claimed() as out:
        found.save(out, command="compare", inputs=inputs)
        wrote = [out, *(save(compare_figure(found), out.with_suffix("")) if figure else ())]
        for row, table in compared.tables.items():
            wrote.append(_table(out, row))
            table.save(wrote[-1], command="compare", inputs={"pendulum": found.pendulum})
    _say(output, found)
    output.wrote(*wrote)
    output.next("evaluate", "POLICY", "--claim", "0.99")
    output.result(**_result(found, wrote))


def _names(text: str) -> list[str]:
    """Return the names of a list that commas separate."""
    names = [name.strip() for name in text.split(",")]
    if not all(names):
        raise InputError(f"{text!r:.60} has an empty name; separate names by single commas")
    return names


def _table(path: Path, row: str) -> Path:
    return path.with_name(f"{path.stem}-{row}.json")


def _compile(
    show: "Show", rows: Sequence[str], worlds: Sequence[str], arm: Any, quick: bool
) -> None:
    """Compile the kernels of trainings and trials, as a stage."""
    from equipoise.control.bound_policy import load_policy
    from equipoise.model.arms.iiwa import iiwa
    from equipoise.model.worlds import IDEAL, MODEL
    from equipoise.studies import compare as study
    from equipoise.studies import compilation

    functions = compilation.FUNCTIONS
    if not set(worlds) <= {IDEAL, MODEL}:
        functions += compilation.TWIN_FUNCTIONS
    machine = arm or iiwa(7)
    with compilation.compiling(show, functions):
        for row in rows:
            if row in study.TRAINED:
                compilation.compile_training(machine, study.settings_of(row, quick=quick))
        for world in worlds:
            compilation.compile_trials(load_policy("lqr", arm=machine), world)


def _say(output: Output, found: "Comparison") -> None:
    short = ", the short form" if found.quick else ""
    output.say(
        f"{found.trials} trials of {found.duration:g} s each on the {found.arm}, seed "
        f"{found.seed}{short}; times are those of this machine"
    )
    cost = ("", "episodes", "steps", "trained in", "size", "a decision")
    output.table(cost, map(_cost, found.rows))
    output.say("Share of the trials that lasted [%], with its 95 % interval")
    titles = ("", *(f"{column.name}<" for column in found.columns))
    output.table(titles, [(row.name, *map(_survival, row.cells)) for row in found.rows])
    output.say("Root mean square of x [mm]; in brackets the median survival [s]")
    output.table(titles, [(row.name, *map(_spread, row.cells)) for row in found.rows])


def _cost(row: "PolicyRow") -> tuple[str, ...]:
    return (
        row.name,
        *("-" if count is None else f"{count:,}" for count in (row.episodes, row.steps)),
        "-" if row.train_s is None else f"{row.train_s:.0f} s",
        "-" if row.size is None else f"{row.size:,} B",
        f"{1e6 * row.decision_s:.1f} µs",
    )


def _survival(cell: "Cell") -> str:
    from equipoise.worlds.formatting import percent

    summary = cell.results.summary()
    low, high = summary.interval
    return f"{percent(summary.rate)} [{percent(low)}, {percent(high)}]".replace(" %", "")


def _spread(cell: "Cell") -> str:
    return f"{1e3 * cell.rms_x:.1f} ({cell.results.summary().median:.1f})"


def _result(found: "Comparison", wrote: Sequence[Path]) -> dict[str, Any]:
    return {
        "comparison": str(wrote[0]),
        "files": [str(path) for path in wrote],
        "quick": found.quick,
        "seed": found.seed,
        "trials": found.trials,
        "duration": found.duration,
        "rows": [
            {
                "name": row.name,
                "kind": row.kind,
                **{name: getattr(row, name) for name in COST},
                "worlds": [
                    {
                        "world": column.world,
                        "told": column.told,
                        **trial_fields(cell.results),
                        "rms_x": cell.rms_x,
                    }
                    for column, cell in zip(found.columns, row.cells, strict=True)
                ],
            }
            for row in found.rows
        ],
    }
