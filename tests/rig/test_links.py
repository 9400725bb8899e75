"""Robot and encoder that fail while nothing moves, in virtual time."""

import re

import pytest

from equipoise import RunLog
from equipoise.errors import LinkError, OutsideError
from equipoise.rig.connection import connect
from equipoise.rig.run import CHECKLIST, run_virtually
from equipoise.robots.kst.plugin import PLUGIN
from tests.rig.test_run import request

ANSWERS = [*(word for word, _ in CHECKLIST + PLUGIN.checklist), "y"]
ENDED = 2.1
"""Longest time from a fault to the end of a run [s]: a driver waits 1 s for a reply, and 1 s for
the end of the connection."""
PATIENCE = 10.0
"""Time after a fault at which a run that still waits has failed the test [s]."""


FAULTS = {
    "the robot's process dies": (0, "close", "closed the link"),
    "the robot's cable is pulled": (0, "cut", "within 1 s|for 0.5 s"),
    "the encoder's board dies": (1, "close", "is gone: .*closed the link"),
    "the encoder falls silent": (1, "cut", "no valid line for 0.5 s"),
}
"""Emulated device, what happens to its link, and the words of the error."""


class Absent:
    """Operator who answers the first questions at once and no other, while a link fails."""

    def __init__(self, emulated, fault, answered, *, at=None, after=0.3):
        (device, self._fault, self.saying), self._rig = FAULTS[fault], emulated
        self._link = emulated.emulated[device].link
        self._words, self.failed_at, self._after = ANSWERS[:answered], at, after
        emulated.clock.attach(self._act)

    def notify(self, event):
        pass

    def read_input(self):
        if self._words:
            return [self._words.pop(0)]
        if self.failed_at is None:
            self.failed_at = self._rig.bench.now + self._after
        return []

    def _act(self, now):
        if self.failed_at is None or now < self.failed_at:
            return
        if self._fault == "cut":
            self._link.cut = True
        else:
            self._link.close()
        assert now < self.failed_at + PATIENCE, "the run goes on with a dead link"


def rig():
    """Return a request for a run, and its emulated rig."""
    wanted = request(duration=1.0, robot="kst://twin:nominal")
    return wanted, connect(wanted)


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("answered", [0, len(ANSWERS) - 1])
def test_a_link_that_fails_at_a_question_ends_the_run(tmp_path, answered, fault):
    out, (wanted, emulated) = tmp_path / "run.mcap", rig()
    person = Absent(emulated, fault, answered)
    with pytest.raises(LinkError, match=person.saying) as failed:
        run_virtually(wanted, out, person, rig=emulated._replace(operator=None))
    assert 0.0 <= emulated.bench.now - person.failed_at < ENDED
    run = RunLog.load(out, damaged=True)
    assert run.end.evidence["text"] == str(failed.value)
    assert len(run.tables["stream"]) == 0


@pytest.mark.parametrize(
    ("fault", "moment"),  # round trips, encoder, their last samples
    list(zip(FAULTS, (1.7, 3.3, 2.7, 3.299), strict=True)),
)
def test_a_link_that_fails_in_the_preflight_ends_a_run_whose_answers_were_typed_ahead(
    fault, moment
):
    wanted, emulated = rig()
    person = Absent(emulated, fault, len(ANSWERS), at=moment)
    with pytest.raises(OutsideError) as failed:
        run_virtually(wanted, None, person, rig=emulated._replace(operator=None))
    assert failed.value.exit_code == 3
    assert re.search(f"{person.saying}|the newest", str(failed.value))  # a check of the pre-flight
