"""The vocabulary of ends: codes of kernels, exit codes, and sentences for people."""

from math import nan

import pytest

from equipoise.log.conditions import RunEnd
from equipoise.model import grid
from equipoise.outcomes import SAFETY_RULES, TRIAL_OUTCOMES, End, Outcome, describe


def test_codes_of_kernels_name_outcomes():
    assert TRIAL_OUTCOMES[grid.TRUNCATED] is Outcome.SURVIVED
    assert TRIAL_OUTCOMES[grid.ANGLE] is Outcome.ANGLE
    assert TRIAL_OUTCOMES[grid.TRACK] is Outcome.TRACK
    assert TRIAL_OUTCOMES[grid.JOINT_LIMIT] is Outcome.JOINT_LIMIT
    assert TRIAL_OUTCOMES[grid.SAFETY_STOP :] == SAFETY_RULES
    # What makes all other numbers meaningless comes first, the fall last.
    assert SAFETY_RULES[:3] == (Outcome.NUMBER, Outcome.COUNT, Outcome.LINK)
    assert SAFETY_RULES[-1] is Outcome.ANGLE


@pytest.mark.parametrize("outcome", Outcome)
def test_each_outcome_has_a_sentence_even_without_its_evidence(outcome):
    assert describe(End(outcome))
    assert describe(End(outcome, {"\x1b[2J{0}": nan, "text": "{value.__class__}"}))


@pytest.mark.parametrize(
    ("outcome", "code"),
    [("survived", 0), ("dry run", 0), ("operator", 130), ("link lost", 3), ("angle", 1)],
)
def test_exit_codes(outcome, code):
    assert RunEnd(outcome=Outcome(outcome)).exit_code == code
    assert RunEnd(outcome=Outcome(outcome), stoppable=False).exit_code == 3


def test_evidence_that_no_file_can_hold_is_text():
    end = RunEnd(evidence={"value": nan, "text": 5000 * "x"})
    assert end.evidence["value"] == "nan"
    assert len(end.evidence["text"]) == 4096
    assert RunEnd.model_validate_json(end.model_dump_json()) == end
