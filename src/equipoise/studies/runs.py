"""Read a log of a run, whoever wrote it: of a rig or of a twin, whole or broken off.

There are two formats. `equipoise.runlog` holds a run on model or twin, from the release to its end.
`equipoise.runwriter` holds the whole course of a run on a rig: the way home, the self-test, the
lift. What both can be asked about is the balancing, and `load_run` returns it as one value, a
`RunLog`, from either.
"""

import csv
import io
from pathlib import Path
from typing import Any, Final, NamedTuple, Self

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from equipoise.artefacts import Number, write_whole
from equipoise.control.states import Phase
from equipoise.errors import ArtefactError, RecordingError
from equipoise.mcapfile import MOST_JOINTS
from equipoise.model.arms.arm import Arm
from equipoise.model.arms.iiwa import iiwa
from equipoise.model.pendulum import PendulumParameters
from equipoise.rigs import RigSettings
from equipoise.runlog import (
    LAYOUTS,
    VERSION,
    EncoderSamples,
    Replies,
    RunConditions,
    RunLog,
    Stream,
)
from equipoise.runwriter import RigRun, is_rig_run, read_rig_run
from equipoise.settings import Settings

Array = npt.NDArray[np.float64]

BROKEN_OFF: Final = "log broken off"
"""Cause of the end of a run whose log does not say how it ended."""
STOPPING: Final = "stopping"
"""Name of the event that says why a run stops."""

UNITS: Final = {
    "time": "s",
    "late": "s",
    "compute": "s",
    "sent": "s",
    "taken": "s",
    "received": "s",
    "x": "m",
    "x_dot": "m_s",
    "phi": "rad",
    "phi_dot": "rad_s",
    "u": "m_s2",
    "tracked": "m_s2",
    "estimated_phi": "rad",
    "estimated_phi_dot": "rad_s",
    "bias": "rad",
    "q": "rad",
    "dq": "rad_s",
}
"""Units of columns, as headers of CSV files name them; others are numbers or words."""
TORQUES: Final = "Nm"
"""Unit of torques in a reply."""


class _Checked(BaseModel):
    model_config = ConfigDict(allow_inf_nan=False)


class _Believed(_Checked):
    """The pendulum that the policy believes in."""

    w2: float = Field(gt=0.0, le=1e6)
    k: float = Field(gt=0.0, le=1e6)
    c: Number
    coulomb: Number
    drag: Number
    linearised: bool


class _RigConditions(_Checked):
    """What studies read of the conditions of a run on a rig."""

    joints: int = Field(ge=1, le=MOST_JOINTS)
    joint_names: list[str]
    arm: str
    held_joint: int | None = Field(ge=1, le=MOST_JOINTS)
    policy: str
    actuator: str
    rig: RigSettings
    robot: str
    encoder: str | None
    settings: Settings
    believed: _Believed
    u_max: float = Field(gt=0.0, le=100.0)
    h: float = Field(ge=1e-4, le=1.0)
    duration: float = Field(ge=0.0, le=1e6)
    t1: bool
    seed: int = Field(ge=0, lt=2**63)
    phases: list[Phase]

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if len(self.joint_names) != self.joints:
            raise ValueError("joint_names names another number of joints")
        if set(self.phases) != set(Phase):
            raise ValueError("phases does not name each phase")
        return self


class _RigEnd(_Checked):
    """What studies read of the end of a run on a rig."""

    cause: str | None = None
    reason: str = ""
    fault: str = ""
    zero: Number | None = None


class LoggedEnding(NamedTuple):
    """How a run ended, as far as its log knows."""

    cause: str
    """In a word or two."""
    reason: str
    """In a sentence; empty where the log has none."""
    phase: Phase | None
    """In which phase it was when it stopped; none where it did not get so far."""
    whole: bool
    """Whether the log reaches to the end."""


def read_any(path: Path) -> RunLog | RigRun:
    """Return what a log holds, in the value of its format.

    Raises:
        ArtefactError: The file is missing, damaged, or no log of a run.
    """
    return read_rig(path) if is_rig_run(path) else RunLog.load(path, damaged=True)


def read_rig(path: Path) -> RigRun:
    """Return the log of a run on a rig, whose conditions and end hold what studies read of them.

    Raises:
        ArtefactError: The file is missing, damaged, or no such log.
    """
    run = read_rig_run(path)
    try:
        _RigConditions.model_validate(run.conditions)
        _RigEnd.model_validate(run.end or {})
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"])) or "conditions"
        raise ArtefactError(
            f"{path} is not a valid log of a run on a rig: {where}: {first['msg']}; run it again"
        ) from None
    state = run.tables["tick"]["state"]
    if np.any((state < 0) | (state >= len(run.conditions["phases"]))):
        raise ArtefactError(
            f"{path} is not a valid log of a run on a rig: a tick has no known phase; run it again"
        )
    return run


def missing_part(run: RunLog | RigRun) -> str:
    """Return what is missing of a log and what is sound, in a sentence; empty of a whole one."""
    damage = _damage(run)
    if not damage:
        return ""
    if isinstance(run, RunLog):
        ticks, lasted = len(run.time), run.lasted
    else:
        time = run.tables["tick"]["time"]
        ticks, lasted = len(time), float(np.ptp(time)) if len(time) else 0.0
    return (
        f"the log {damage}; sound before that: {ticks:,} ticks, {lasted:.2f} s; what came after is "
        "not known"
    )


def _damage(run: RunLog | RigRun) -> str:
    if run.damage or isinstance(run, RunLog):
        return run.damage
    return "" if run.end is not None else "breaks off"


def load_run(path: Path) -> RunLog:
    """Return the balancing of a run, from a log of either format.

    Raises:
        ArtefactError: The file is missing, damaged, or no log of a run.
        RecordingError: It is the log of a run on a rig that did not get as far as balancing.
    """
    run = read_any(path)
    if isinstance(run, RunLog):
        return run
    try:
        return balancing(run)
    except RecordingError as error:
        raise RecordingError(f"{path}: {error}") from None


def ending(run: RigRun) -> LoggedEnding:
    """Return how a run on a rig ended."""
    tick = run.tables["tick"]
    names = [Phase(name) for name in run.conditions["phases"]]
    course = [names[state] for state in tick["state"].tolist()]
    before = [phase for phase in course if phase is not Phase.STOPPING]
    phase = before[-1] if before else None
    told = [event.text for event in run.events if event.name in (STOPPING, "fault")]
    if run.end is not None and "cause" in run.end:
        return LoggedEnding(str(run.end["cause"]), str(run.end.get("reason", "")), phase, True)
    if run.end is not None:
        fault = run.end.get("fault", "an error ended the run; deploy has said which")
        return LoggedEnding("error", str(fault), phase, True)
    return LoggedEnding(BROKEN_OFF, told[-1] if told else "", phase, False)


def arm_of(run: RunLog | RigRun) -> Arm | None:
    """Return the arm of a run, as it stood there; none where its log does not hold it."""
    if isinstance(run, RigRun):
        return RigSettings.model_validate(run.conditions["rig"]).described_arm
    known = {one.name: one for one in (iiwa(7), iiwa(14))}
    arm = known.get(run.conditions.arm)
    return arm if arm and len(arm.joints) == len(run.conditions.joints) else None


def pendulum_of(run: RunLog | RigRun) -> PendulumParameters:
    """Return the pendulum of a run: on a rig, as the policy believes it to be."""
    if isinstance(run, RigRun):
        return PendulumParameters(**run.conditions["believed"])
    of = run.conditions.pendulum
    return PendulumParameters(of["w2"], of["k"], of["c"], of["coulomb"], of["drag"])


def phase_ticks(run: RigRun, *phases: Phase) -> npt.NDArray[np.int64]:
    """Return the places of the ticks that were in one of some phases, shape (n,)."""
    states = [run.conditions["phases"].index(phase.value) for phase in phases]
    return np.flatnonzero(np.isin(run.tables["tick"]["state"], states))


def balancing_ticks(run: RigRun) -> npt.NDArray[np.int64]:
    """Return the places of the ticks in which the policy decided, shape (n,).

    Raises:
        RecordingError: The run did not get so far.
    """
    ticks = phase_ticks(run, Phase.BALANCING)
    if len(ticks) == 0:
        how = ending(run)
        where = how.phase.value if how.phase else "connecting"
        raise RecordingError(
            f"the run did not get as far as balancing, it ended while {where}"
            f"{f' ({how.reason})' if how.reason else ''}; give one that did"
        )
    return ticks


def balancing(run: RigRun) -> RunLog:
    """Return the balancing of a run on a rig.

    Counts are from where the pendulum hangs, to a whole one. What nobody knows on a rig is left
    out: the truth, the error of the zero. The acceleration that the flange follows is that of its
    reference.

    Raises:
        ArtefactError: The log does not hold what it should.
        RecordingError: The run did not get so far.
    """
    told, rows = run.conditions, run.tables["tick"][balancing_ticks(run)]
    began, last = float(rows["time"][0]), float(rows["time"][-1])
    h = float(told["h"])

    def within(name: str, times: Array) -> npt.NDArray[Any]:
        return run.tables[name][(times >= began - h) & (times <= last + h)]

    stream = within("stream", run.tables["stream"]["time"])
    encoder = within("encoder", run.tables["encoder"]["time"])
    reply = within("reply", run.tables["reply"]["time"])
    reply = reply[np.isfinite(reply["q"]).all(axis=1) & np.isfinite(reply["sent"])]
    zero = encoder_zero(run)
    first = {name: float(rows[name][0]) for name in ("x", "x_dot", "phi", "phi_dot")}
    try:
        conditions = RunConditions(
            policy=told["policy"],
            world=told["robot"],
            arm=told["arm"],
            joints=tuple(told["joint_names"]),
            held_joint=told["held_joint"],
            pendulum={
                name: float(told["believed"][name]) for name in ("w2", "k", "c", "coulomb", "drag")
            },
            start=(first["x"], first["x_dot"], first["phi"], first["phi_dot"]),
            h=h,
            duration=float(told["duration"]),
            seed=int(told["seed"]),
            actuator=told["actuator"],
            counts_per_rev=int(told["rig"]["counts_per_rev"]),
            world_settings=None,
            zero_error=None,
            settings=Settings.model_validate(told["settings"]),
            friction=told.get("friction"),
            cause=ending(run).cause,
        )
    except (KeyError, TypeError, ValidationError) as error:
        raise ArtefactError(
            f"the conditions of the run are incomplete ({error}); run it again"
        ) from None
    return RunLog(
        conditions=conditions,
        time=rows["time"] - began,
        x=rows["x"],
        x_dot=rows["x_dot"],
        phi=rows["phi"],
        phi_dot=rows["phi_dot"],
        box=rows["box"],
        u=rows["u"],
        tracked=np.diff(rows["x_dot"], append=rows["x_dot"][-1:]) / h,
        q=rows["q"],
        dq=rows["dq"],
        estimated_phi=rows["estimated_phi"],
        estimated_phi_dot=rows["estimated_phi_dot"],
        bias=rows["bias"],
        stream=Stream(stream["time"] - began, stream["q"]),
        replies=Replies(0.5 * (reply["sent"] + reply["time"]) - began, reply["q"]),
        encoder=EncoderSamples(encoder["time"] - began, encoder["counts"] - round(zero)),
        damage=_damage(run),
    )


def encoder_zero(run: RigRun) -> float:
    """Return what the encoder counts where the pendulum hangs, up to whole turns.

    It is told at the end; of a log that has none, the last angle in the operator's hand and the
    newest count of that tick tell it.

    Raises:
        ArtefactError: The log has neither.
    """
    if run.end is not None and run.end.get("zero") is not None:
        return float(run.end["zero"])
    armed = phase_ticks(run, Phase.ARMED)
    if len(armed) == 0:
        raise ArtefactError("the log does not tell the encoder's zero; give one that is whole")
    tick, encoder = run.tables["tick"][armed[-1]], run.tables["encoder"]
    known = encoder["counts"][encoder["received"] <= tick["time"]]
    if len(known) == 0:
        raise ArtefactError("the log holds no count before the release; give one that is whole")
    counts = known[-1]
    counts_per_rev = int(run.conditions["rig"]["counts_per_rev"])
    return float(counts - (np.pi - tick["estimated_phi"]) * counts_per_rev / (2.0 * np.pi))


# CSV.


def export(run: RunLog | RigRun, folder: Path) -> list[Path]:
    """Write each table of a log as a CSV file, with a header that has the units.

    Args:
        run: The log.
        folder: Where; it is made if it is missing. Files of the same names are replaced.

    Returns:
        The files that were written.

    Raises:
        OutsideError: The disk refuses.
    """
    made: list[Path] = []
    for name, (header, rows) in _tables(run).items():
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(header)
        writer.writerows(rows)
        made.append(folder / f"{name}.csv")
        write_whole(made[-1], text.getvalue().encode())
    return made


def _tables(run: RunLog | RigRun) -> dict[str, tuple[list[str], list[list[Any]]]]:
    tables = dict[str, tuple[list[str], list[list[Any]]]]()
    if isinstance(run, RigRun):
        for name, rows in run.tables.items():
            columns = {column: rows[column] for column in rows.dtype.names or ()}
            tables[name] = _plain(columns, run.conditions["joint_names"])
        events = [[e.time, e.name, "|".join(e.answers), e.text] for e in run.events]
        tables["event"] = (["time_s", "name", "answers", "text"], events)
        return tables
    for topic, paths in LAYOUTS[VERSION].items():
        columns = dict[str, npt.NDArray[Any]]()
        for path in paths:
            part, _, column = path.rpartition(".")
            columns[column] = getattr(getattr(run, part) if part else run, column)
        if topic == "/truth" and len(run.truth.x):
            columns = {"time": run.time, **columns}
        if len(next(iter(columns.values()))):
            tables[topic.removeprefix("/")] = _plain(columns, run.conditions.joints)
    return tables


def _plain(
    columns: dict[str, npt.NDArray[Any]], joints: tuple[str, ...] | list[str]
) -> tuple[list[str], list[list[Any]]]:
    """Return header and rows; a column with a number per joint becomes one for each joint."""
    header, flat = list[str](), list[list[Any]]()
    for name, values in columns.items():
        per_joint = values.ndim == 2
        unit = TORQUES if name == "torque" and per_joint else UNITS.get(name, "")
        suffix = f"_{unit}" if unit else ""
        if per_joint:
            header += [f"{name}_{joint}{suffix}" for joint in joints]
            flat += values.T.tolist()
        else:
            header.append(name + suffix)
            flat.append(values.tolist())
    rows = [["" if value != value else value for value in row] for row in zip(*flat, strict=True)]
    return header, rows
