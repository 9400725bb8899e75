"""Logs for tests: of a short run on the twin, and of a rig that nobody ran."""

import dataclasses
import resource
from contextlib import contextmanager

import numpy as np

from equipoise import PendulumParameters, iiwa, resolve, shipped_policy, simulate_run
from equipoise.arm.posture import along_x
from equipoise.log.columns import tables
from equipoise.log.conditions import RunConditions, RunEnd
from equipoise.log.recorder import Recorder
from equipoise.log.run_log import RunLog
from equipoise.log.writer import RunWriter
from equipoise.outcomes import Outcome, Phase
from equipoise.rig.run_controller import PHASES


def conditions(**changes):
    """Conditions of a run on a twin."""
    given = {
        "policy": "sha256:0123",
        "world": "twin:nominal",
        "arm": iiwa(7),
        "pendulum": PendulumParameters(70.2, 7.15, 0.15),
        "start": (0.0, 0.0, 0.03, 0.2),
        "h": 0.01,
        "duration": 60.0,
        "seed": 4,
        "actuator": "sha256:4567",
        "counts_per_rev": 8192,
        "world_settings": {"transport": 0.01, "cycle": 0.001, "counts_per_rev": 8192, "drag": 0.0},
        "zero_error": 0.002,
        "settings": resolve("paper"),
    }
    return RunConditions(**(given | changes))


def rig_conditions(**changes):
    """Conditions of a run on a rig."""
    rig = {
        "world": "kst://rig",
        "start": None,
        "world_settings": None,
        "zero_error": None,
        "rig": {"counts_per_rev": 8192},
        "phases": PHASES,
    }
    return conditions(**(rig | changes))


def short_run():
    """A run on the twin, 40 ticks long."""
    return simulate_run(shipped_policy(), world="twin:nominal", duration=0.4)


def changed_table(run, table, **new):
    """The same run with other columns in one of its tables; rows are made where it has none."""
    length = len(next(iter(new.values())))
    rows = run.tables[table]
    rows = np.zeros(length, rows.dtype) if len(rows) != length else rows.copy()
    for name, values in new.items():
        rows[name] = values
    return dataclasses.replace(run, tables=dict(run.tables) | {table: rows})


RIG, POSTURE = rig_conditions(), np.linspace(0.0, 0.6, 7)


def push(recorder, ticks, begin=0):
    """Record the rows of ticks; nothing depends on what they mean."""
    for i in range(begin, begin + ticks):
        t = 0.01 * i
        recorder.tick.push(time=t, state=3, x=0.1, phi=0.2, box=17, u=-2.0, q=POSTURE)
        recorder.stream.push(time=t, q=POSTURE)
        recorder.reply.push(time=t, sent=t - 0.004, q=POSTURE, taken=t)
        recorder.encoder.push(time=t, counts=4096 + i, received=t)


def drained(path, ticks):
    """Begin a log on a rig; return its recorder and its writer."""
    recorder, writer = Recorder(7), RunWriter(path, RIG, 0.0)
    for begin in range(0, ticks, 100):
        push(recorder, min(100, ticks - begin), begin)
        writer.drain(recorder)
    return recorder, writer


RELEASE, END = 7.0, 10.0
"""Release and end of the run below, on its clock [s]."""
RESTING = 123.0
"""Counts of the pendulum at rest."""


def x_on_a_rig(time):
    return 0.05 * np.sin(2.0 * np.maximum(time - RELEASE, 0.0))


def phi_on_a_rig(time):
    return np.radians(3.0) * np.cos(5.0 * time)


def balanced_on_a_rig():
    """Ticks of 10 ms from 1 s on, lifted until 7 s, balancing until 9 s, at rest at 10 s."""
    arm, kinds = iiwa(7), tables(7)
    tick = np.zeros(901, kinds["tick"])
    tick["time"] = np.arange(1.0, END + 0.005, 0.01)
    state = np.where(tick["time"] < RELEASE - 0.001, Phase.LIFTING, Phase.BALANCING)
    state[tick["time"] > 9.0 + 0.001] = Phase.STOPPING
    tick["state"] = [PHASES.index(Phase(one)) for one in state]
    tick["u"] = np.where(tick["state"] == PHASES.index(Phase.BALANCING), 1.5, np.nan)
    reply = np.zeros(901, kinds["reply"])
    reply["sent"], reply["time"] = tick["time"], tick["time"] + 0.004
    reply["q"] = [arm.with_held(q) for q in along_x(arm, x_on_a_rig(tick["time"] + 0.002))]
    reply["q"][7::20] = np.nan  # replies that tell torques
    reply["sent"][0] = np.nan  # the posture at the start
    encoder = np.zeros(9001, kinds["encoder"])
    encoder["time"] = np.linspace(1.0, END, 9001)
    theta = np.pi - phi_on_a_rig(encoder["time"])
    counts = RESTING + (theta + 4.0 * np.pi) * 8192 / (2.0 * np.pi)
    encoder["counts"] = np.round(counts)
    end = RunEnd(outcome=Outcome.SURVIVED, zero=RESTING)
    none = {name: np.zeros(0, kind) for name, kind in kinds.items()}
    rows = none | {"tick": tick, "reply": reply, "encoder": encoder}
    return RunLog(rig_conditions(), rows, end)


@contextmanager
def full_disk(room):
    """No file may grow beyond `room` bytes."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (room, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
