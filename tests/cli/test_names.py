"""Names of files: second calls, calls at the same time, and calls that fail."""

import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from equipoise import Pendulum, RunLog, shipped_policy, simulate_run
from tests.cli.conftest import contents
from tests.program import run_program

RUN = ("deploy", "--duration=0.3", "--json")

SECOND_CALLS = {
    "identify swing.csv": {"pendulum.json", "pendulum.svg", "pendulum.png"},
    "log export given.mcap": {"given-csv/tick.csv", "given-csv/truth.csv"},
}


def together(*commands):
    """Start commands at the same time; return their exit codes and messages."""

    def run(words):
        ran = run_program(sys.executable, "-m", "equipoise", *words, check=False)
        return ran.returncode, ran.stderr

    with ThreadPoolExecutor(len(commands)) as pool:
        return sorted(pool.map(run, commands))


@pytest.mark.parametrize("call", SECOND_CALLS)
def test_a_second_call_takes_the_next_name_and_says_so(equipoise, swing, tmp_path, call):
    if "given" in call:
        simulate_run(shipped_policy(), duration=0.3).save(tmp_path / "given.mcap")
    before = contents(tmp_path)
    equipoise(*call.split())
    first = contents(tmp_path)
    made = first.keys() - before.keys()
    assert made >= SECOND_CALLS[call]
    second = equipoise(*call.split())
    name, *_ = sorted(file.partition("/")[0] for file in SECOND_CALLS[call])
    free = Path(name).with_stem(Path(name).stem + "-2")
    assert second.out.splitlines()[0] == f"{name} is taken; writing {free}"
    after = contents(tmp_path)
    assert first.items() <= after.items()
    assert {file.replace("-2", "") for file in after.keys() - first.keys()} == made


@pytest.mark.full
def test_commands_at_the_same_time_lose_nothing(swing, tmp_path):
    runs = [(*RUN, f"--seed={seed}") for seed in (1, 2)]
    done = together(*runs, *[("identify", "swing.csv")] * 2)
    assert [code for code, _ in done] == [0] * 4
    names = {"run.mcap", "run-2.mcap"}
    assert {RunLog.load(tmp_path / name).conditions.seed for name in names} == {1, 2}
    stems = {"pendulum", "pendulum-2"}
    assert len({Pendulum.load(tmp_path / f"{stem}.json").digest for stem in stems}) == 1
    figures = {f"{stem}.{end}" for stem in stems for end in ("json", "svg", "png")}
    assert contents(tmp_path).keys() == {"swing.csv"} | names | figures
    (first, _), (second, message) = together(*[(*run, "--out=named.mcap") for run in runs])
    assert (first, second) == (0, 2)
    assert message.startswith("error: ")
    assert message.count("\n") == 1
    assert RunLog.load(tmp_path / "named.mcap").conditions.seed in (1, 2)


def test_a_verb_that_fails_leaves_neither_file_nor_folder(equipoise, tmp_path):
    equipoise("reproduce", "--swing", "none.csv", "--out", "deep/report", code=2)
    assert not list(tmp_path.iterdir())
