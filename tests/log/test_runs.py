"""Logs of either format are read as one, and exported."""

import csv

import numpy as np
import pytest

from equipoise import iiwa
from equipoise.identification.refine import read_motion
from equipoise.log.run_log import RunLog
from equipoise.outcomes import Outcome
from tests.conftest import written


def table(path):
    with path.open() as file:
        header, *rows = csv.reader(file)
    return header, rows


def test_counts_and_joints_of_a_rig_tell_what_the_observer_believed(rig_log):
    # What refine reads, beside what the estimator made of the same counts at the ticks.
    log = RunLog.load(rig_log)
    assert log.time == pytest.approx(0.01 * np.arange(150))
    # 1000 samples, 200 setpoints and (but for torques) 180 replies a second.
    assert len(log.encoder.time) == pytest.approx(1520, abs=10)
    assert len(log.stream.time) == pytest.approx(304, abs=3)
    assert len(log.replies.time) == pytest.approx(274, abs=3)
    assert len(log.tables["tick"]) > 10 * len(log.time)
    motion = read_motion(log, iiwa(7))
    phi = np.interp(log.time, motion.time, motion.phi)
    believed = log.ticks.estimated_phi + log.ticks.bias
    assert np.rad2deg(phi - believed)[10:] == pytest.approx(0.0, abs=0.4)
    x = np.interp(log.time + 0.03, motion.time, motion.x)
    assert x[:-5] == pytest.approx(log.ticks.x[:-5], abs=0.01)


def test_a_log_that_breaks_off_is_read_to_its_last_chunk(rig_log):
    recorded = rig_log.read_bytes()
    broken_off = written("cut.mcap", recorded[: int(0.94 * len(recorded))])  # half a second short
    log, whole = RunLog.load(broken_off, damaged=True), RunLog.load(rig_log)
    assert (log.ending.outcome, bool(log.damage)) == (Outcome.BROKEN_OFF, True)
    assert 10 < len(log.time) < len(whole.time)
    assert log.ticks.phi.tolist() == whole.ticks.phi[: len(log.time)].tolist()
    # Nobody said where the zero is: the last angle in the hand does.
    n = len(log.encoder.counts)
    away = log.encoder.counts - whole.encoder.counts[:n]
    turn = whole.conditions.counts_per_rev
    assert np.all((away + turn // 2) % turn - turn // 2 == 0)


def test_every_table_is_exported_with_units(rig_log, tmp_path):
    run = RunLog.load(rig_log)
    made = run.export(tmp_path / "csv")
    assert [path.stem for path in made] == ["tick", "stream", "reply", "encoder", "event"]
    assert {path.suffix for path in made} == {".csv"}
    header, rows = table(made[0])
    assert {"time_s", "late_s", "state", "x_dot_m_s", "dq_A7_rad_s"} <= set(header)
    assert len(rows) == len(run.tables["tick"])
    assert rows[0][header.index("x_m")] == ""  # not known on the way home
    column = header.index("q_A2_rad")
    assert [float(row[column]) for row in rows] == run.tables["tick"]["q"][:, 1].tolist()
    assert "torque_A1_Nm" in table(made[2])[0]
    assert [row[3] for row in table(made[4])[1]] == [event.text for event in run.events]
