"""Checkpoint: state of an unfinished training; resumed, it gives the bits of an unbroken one.

A training is a function of its inputs and of its state between two calls of `train_episodes`. The
state includes the running episodes, so a training resumes in the middle of them.
"""

from collections.abc import Iterator
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
from pydantic import ConfigDict, Field

from equipoise.artefacts import Artefact, Count, Number, Value
from equipoise.control.grid import ACTIONS
from equipoise.control.policy import LearningPoint, TabularPolicy, TargetTest
from equipoise.errors import ArtefactError
from equipoise.learning.episodes import BEGUN, ENDED, IN_USE, TrainingState
from equipoise.learning.learner import UNDECIDED
from equipoise.model.elementary import BATCH_SIZE


class _Bytes(Value):
    """Value whose bytes are written to files as base64."""

    model_config = ConfigDict(ser_json_bytes="base64", val_json_bytes="base64")


class StoredCandidate(_Bytes):
    """Candidate of the selection."""

    episodes: Count
    """Number of episodes before it."""
    Q: bytes
    """Averaged state-action values; float64, a row of 8 for each box."""


class LearnerState(_Bytes):
    """State of one learner between two candidates."""

    trainings: tuple[bytes, ...]
    """All arrays of `episodes.TrainingState` in their order, for each actuator."""
    averaged: bytes
    """Running average of the table; float64, a row of 8 for each box."""
    averages: Count
    """Number of tables in the average."""
    candidates: tuple[StoredCandidate, ...]
    """Candidates up to this point, in their order."""
    curve: tuple[LearningPoint, ...] = Field(min_length=1)
    """Learning curve up to this point."""


class LearnerResult(Value):
    """Figures of a learner that has been trained and tested."""

    learner: Count
    """Number of the learner."""
    steps: Count
    """Number of its control steps."""
    episodes: Count
    """Number of episodes of the selected policy."""
    score: Number | None
    """Score of the selected policy in the race; None without a selection."""
    test: TargetTest
    """Test of the selected policy."""


class ResumePoint(Artefact):
    """Unfinished training of one or several learners."""

    FORMAT: ClassVar[str] = "equipoise-checkpoint"
    VERSION: ClassVar[int] = 2

    deciding: dict[str, str]
    """Digest of each input that decides about the result, by its name."""
    learners: dict[str, LearnerState]
    """State of each unfinished learner, by its number."""
    finished: tuple[LearnerResult, ...]
    """Figures of the finished learners."""
    best: TabularPolicy | None
    """Best policy of the finished learners."""


def pack(training: TrainingState) -> bytes:
    """Return the concatenated bytes of all arrays of a training."""
    return b"".join(array.tobytes() for array in _arrays(training))


def unpack(data: bytes, training: TrainingState) -> None:
    """Write bytes of `pack` into the arrays of a training.

    Args:
        data: The bytes.
        training: A new training, changed in place.

    Raises:
        ArtefactError: The size is wrong, or an index is out of range.
    """
    arrays = list(_arrays(training))
    if len(data) != sum(array.nbytes for array in arrays):
        raise _damaged(f"{len(data)} bytes of state")
    place = 0
    for array in arrays:
        array[...] = np.frombuffer(data, array.dtype, array.size, place).reshape(array.shape)
        place += array.nbytes
    # Compiled code does not check its indices.
    totals = training.totals
    bounds = {
        "box": (training.decisions.box, 0, len(training.tables.Q)),
        "place": (training.decisions.place, 0, BATCH_SIZE),
        "action": (training.decisions.action, UNDECIDED, ACTIONS),
        "lanes in use": (totals[IN_USE], 0, BATCH_SIZE + 1),
        "episodes ended": (totals[ENDED], 0, int(totals[BEGUN]) + 1),
    }
    for name, (values, first, end) in bounds.items():
        if np.any(values < first) or np.any(values >= end):
            raise _damaged(f"{name} out of range")


def table(data: bytes, boxes: int) -> npt.NDArray[np.float64]:
    """Return a table from its bytes, shape (boxes, 8).

    Raises:
        ArtefactError: The bytes have another size.
    """
    if len(data) != boxes * ACTIONS * 8:
        raise _damaged(f"a table of {len(data)} bytes")
    return np.frombuffer(data, np.float64).reshape(boxes, ACTIONS).copy()


def _arrays(values: Any) -> Iterator[npt.NDArray[Any]]:
    for value in values:
        if isinstance(value, np.ndarray):
            yield value
        else:
            yield from _arrays(value)


def _damaged(what: str) -> ArtefactError:
    return ArtefactError(
        f"the checkpoint has {what}, which no training has; delete it and train again"
    )
