"""A series of runs without a hand: what leads on, what ends it, and its logs."""

from math import radians

import pytest

from equipoise.log.conditions import RunEnd
from equipoise.log.recorder import Recorder
from equipoise.log.run_log import RunLog
from equipoise.outcomes import Outcome
from equipoise.rig import series
from equipoise.rig.connection import connect
from equipoise.rig.run import run_virtually
from equipoise.rig.series import RunLogs, Series, summarise
from tests.log.made_up import conditions, push
from tests.rig.replayed import replay
from tests.rig.test_run import POLICY, Scripted, request


def run(out, *, after_run=None, **acts):
    """Run a series of two, with the acts of its operator, and a word that it types in between."""
    wanted = request(duration=1.0, start="hanging", runs=2)
    rig, ends = connect(wanted), []
    operator = Scripted(rig.bench, **acts)

    def ended(end):
        ends.append(end)
        operator.typed += [after_run] if after_run else []

    end = run_virtually(wanted, out, operator, rig=rig, ended=ended)
    return [*ends, end], operator.names


@pytest.fixture(scope="module")
def fallen(tmp_path_factory):
    """A series whose first run ends by a push."""
    out = tmp_path_factory.mktemp("series") / "run.mcap"
    ends, names = run(out, balancing=lambda bench: bench.push(radians(250.0)))
    return out, ends, names


def test_a_fall_leads_to_a_run_that_swings_up_again_without_a_hand(fallen):
    _, ends, names = fallen
    assert [end.outcome for end in ends] == ["angle", "survived"]
    second = names[names.index("stopping") :]
    order = ["run", "homing", "home", "hang", "lift", "damping", "swing", "swing-up", "balancing"]
    kept = [name for name in second if name in order]
    assert kept == ["run", "homing", "damping", "swing", "swing-up", "balancing"]


def test_each_run_has_a_log_that_replays_to_the_bit_and_the_zero_stays(fallen):
    out, ends, _ = fallen
    for number, end in enumerate(ends, start=1):
        log = RunLog.load(out.with_name(f"run-00{number}.mcap"))
        assert log.end == end
        assert replay(log, POLICY) == (len(log.tables["tick"]), [])
    assert ends[0].zero == ends[1].zero
    assert abs(ends[1].zero_change) < radians(0.1)
    assert ends[1].w2 == pytest.approx(70.2, rel=0.01)


def test_the_summary_holds_the_ends_and_counts_them(fallen):
    out, ends, _ = fallen
    summary = Series.load(out.with_name("run-series.json"))
    assert list(summary.runs) == ends
    counted = summarise(ends)
    assert (counted["runs"], counted["survived"]) == (2, 1)
    assert counted["outcomes"] == {"angle": 1, "survived": 1}


@pytest.mark.parametrize(
    ("when", "outcomes"),
    [("run", ["operator"]), ("stopping", ["survived"]), ("after_run", ["survived", "operator"])],
)
def test_a_key_after_the_stop_or_between_two_runs_ends_the_series(tmp_path, when, outcomes):
    ends, names = run(tmp_path / "run.mcap", **{when: "x"})
    assert [end.outcome for end in ends] == outcomes
    assert names.count("homing") <= 1
    assert [RunLog.load(path).end for path in sorted(tmp_path.glob("*.mcap"))] == ends


def test_older_logs_of_a_long_series_are_deleted(tmp_path, monkeypatch, fallen):
    monkeypatch.setattr(series, "MAX_LOGS", 2)
    log, recorder = RunLog.load(fallen[0].with_name("run-002.mcap")), Recorder(7)
    logs = RunLogs(tmp_path / "a.mcap", log.conditions, 4, 0.0)
    for number in range(4):
        recorder.stream.push(time=float(number), q=log.conditions.arm.home)
        if number < 3:
            logs.follow(recorder, float(number), log.end, log.conditions)
    logs.finish(recorder, 4.0, log.end)
    assert logs.problem is None
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["a-003.mcap", "a-004.mcap", "a-series.json"]
    assert len(Series.load(tmp_path / "a-series.json").runs) == 4


def test_a_disk_that_takes_no_log_leaves_the_series_running(tmp_path, monkeypatch):
    usual = series.Path.open

    def refuse(path, mode="r", *args, **options):
        if "r" in mode:
            return usual(path, mode, *args, **options)
        raise OSError(28, "no space left")

    def fill(_):
        monkeypatch.setattr(series.Path, "open", refuse)

    ends, names = run(tmp_path / "run.mcap", stopping=fill)
    assert [end.outcome for end in ends] == [Outcome.SURVIVED] * 2
    assert "warning" in names


def test_rows_that_the_disk_was_too_slow_for_are_named(tmp_path):
    logs, recorder = RunLogs(tmp_path / "run.mcap", conditions(), 1, 0.0), Recorder(7)
    push(recorder, 1500)
    logs.finish(recorder, 15.0, RunEnd())
    assert f"too slow for {recorder.lost:,} rows" in logs.problem
    assert logs.ends[0].lost_rows == recorder.lost > 0
