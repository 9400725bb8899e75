"""A whole run on emulated rigs, in virtual time, with all guards on."""

import numpy as np
import pytest

from equipoise.control.policy import shipped_policy
from equipoise.control.ticks import OperatorMessage
from equipoise.identification.actuator import identify_actuator
from equipoise.logs.recorder import Recorder, read_events
from equipoise.logs.run_log import RunLog
from equipoise.outcomes import Phase
from equipoise.rig.clocks import VirtualClock
from equipoise.rig.config import RigSettings
from equipoise.rig.connection import connect
from equipoise.rig.plugins import ignore
from equipoise.rig.request import RunRequest, describe_fit
from equipoise.rig.run import OperatorChannel, run_virtually
from equipoise.rig.run_controller import PHASES
from tests.rig.replayed import replay

pytestmark = pytest.mark.compiled_only

POLICY = shipped_policy()


class Spy:
    """Is told, and speaks once after an event of a name."""

    def __init__(self, after="", word="stop"):
        self.names, self._after, self._word = [], after, word

    def notify(self, event):
        self.names.append(event.name)

    def read_input(self):
        if self._after and self._after in self.names:
            self._after = ""
            return [self._word]
        return []


def request(duration=2.0, robot="twin:nominal", settings=None, policy=POLICY, seed=3, **changes):
    settings = settings or RigSettings()
    return RunRequest(
        policy, policy.actuator, settings, robot, None, duration, seed=seed, **changes
    )


def test_it_stands_on_the_twin_and_the_log_says_how(tmp_path):
    out, spy = tmp_path / "run.mcap", Spy()
    outcome = run_virtually(request(), out, spy)
    assert (outcome.outcome, outcome.lasted, outcome.exit_code) == ("lasted", 2.0, 0)
    order = ["homing", "home", "reference", "swing", "self-test", "lift", "armed", "balancing"]
    assert [name for name in spy.names if name in order] == order
    run = RunLog.load(out, damaged=True)
    tick, stream = run.tables["tick"], run.tables["stream"]
    balancing = tick["state"] == PHASES.index(Phase.BALANCING)
    assert balancing.sum() == 200
    assert np.abs(tick["phi"][balancing]).max() < np.radians(8.0)
    # Two setpoints in each tick, within the limits of the arm, from first to last.
    assert len(stream) == 2 * len(tick)
    limits = np.array([(j.velocity, j.acceleration) for j in POLICY.arm.joints]).T
    steps = np.diff(stream["q"], axis=0) / 0.005
    assert (np.abs(steps) <= limits[0] * 1.001).all()
    assert (np.abs(np.diff(steps, axis=0)) / 0.005 <= limits[1] * 1.001).all()
    assert run.end.outcome == "lasted"


@pytest.mark.slow
def test_an_excitation_before_the_lift_refuses_a_policy_for_another_arm(tmp_path):
    out = tmp_path / "run.mcap"
    wanted = request(robot="twin:pd", identify=identify_actuator)
    end = run_virtually(wanted, out, Spy())
    assert (end.outcome, end.exit_code, end.lasted) == ("arm not identified", 1, 0.0)
    assert "It does not fit the actuator of policy" in end.reason
    run = RunLog.load(out, damaged=True)
    found = run.end.identified
    assert found.cycle.value == pytest.approx(0.016, rel=0.02)
    assert run.conditions.identifies
    assert replay(run, POLICY) == (len(run.tables["tick"]), [])
    # A policy that was trained for it fits.
    trained = POLICY.model_copy(update={"actuator": found, "test": None})
    assert describe_fit(trained, found).endswith("It fits the actuator of policy.")


@pytest.mark.parametrize("when", ["homing", "swing", "balancing"])
def test_any_word_stops_it_in_the_same_tick_and_the_arm_comes_to_rest(tmp_path, when):
    out = tmp_path / "run.mcap"
    outcome = run_virtually(request(), out, Spy(after=when))
    assert (outcome.outcome, outcome.exit_code) == ("operator", 130)
    run = RunLog.load(out, damaged=True)
    tick = run.tables["tick"]
    stopping = tick["state"] == PHASES.index(Phase.STOPPING)
    stopped_at = next(event.time for event in run.events if event.name == "stopping")
    assert tick["time"][stopping][0] == pytest.approx(stopped_at)
    assert np.abs(tick["dq"][-1]).max() == 0.0
    # It never moves again.
    assert stopping[np.argmax(stopping) :].all()


def test_a_dry_run_moves_nothing(tmp_path):
    out, spy = tmp_path / "run.mcap", Spy()
    outcome = run_virtually(request(dry_run=True), out, spy)
    assert (outcome.outcome, outcome.exit_code) == ("dry run", 0)
    assert "checklist" in spy.names
    assert len(RunLog.load(out, damaged=True).tables["stream"]) == 0


class Script:
    """Types all it has to say at once."""

    def __init__(self, *words):
        self.told, self._words = [], list(words)

    def notify(self, event):
        self.told.append(event.text)

    def read_input(self):
        words, self._words = self._words, []
        return words


def test_words_that_come_together_answer_one_question_after_the_other():
    clock, recorder = VirtualClock(), Recorder(7)
    channel = OperatorChannel([Script("estop", " Fence \n", "stop")], recorder, clock, ignore)
    asked = [("a", "estop"), ("b", "fence")]
    assert [channel.ask(OperatorMessage("checklist", text, (word,))) for text, word in asked] == [
        "estop",
        "fence",
    ]
    # What was left over is not lost: the loop hears it, and stops.
    assert channel.read_input() == ["stop"]
    assert channel.read_input() == []
    logged = [(event.name, event.text) for event in read_events(recorder.event.take())]
    assert logged == [
        ("checklist", "a"),
        ("word", "estop"),
        ("checklist", "b"),
        ("word", " Fence \n"),
    ]


def answered_by(script, wanted):
    """Run with a script alone, without the twin's own operator."""
    return run_virtually(wanted, None, script, rig=connect(wanted)._replace(operator=None))


@pytest.mark.parametrize(
    ("typed", "cause", "asked"),
    [
        (["estpo", "", "estop", "fnece", "fence", "monitoring", "t1"], "dry run", 7),
        (["no", "estop"], "operator", 1),
        (["estop", "stop", "fence"], "operator", 2),
    ],
)
def test_a_mistyped_word_is_asked_again(typed, cause, asked):
    script = Script(*typed)
    assert answered_by(script, request(dry_run=True)).outcome == cause
    assert sum("Type" in text for text in script.told) == asked


def test_a_stop_that_came_with_the_last_answer_is_heard_in_the_first_tick():
    script = Script("estop", "fence", "monitoring", "t1", "y", "stop")
    outcome = answered_by(script, request())
    assert (outcome.outcome, outcome.lasted) == ("operator", 0.0)
    assert "stopped by the operator (stop)" in script.told
