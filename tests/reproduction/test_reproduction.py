"""Reproduction: every stage, one after the other, and its folder."""

import numpy as np
import pytest

from equipoise import Trajectory, paper, read_swing, read_urdf, shipped_actuator
from equipoise.errors import OutsideError, RecordingError
from equipoise.files import read_document
from equipoise.model.worlds import IDEAL, MODEL
from equipoise.report.page import build
from equipoise.reproduction.pipeline import TWIN, reproduce
from equipoise.reproduction.results import POLICY, SWING
from equipoise.reproduction.synthetic_swing import SIMULATED_C, SIMULATED_HOLD, synthetic_swing
from equipoise.settings import EvaluationSettings, LearningSettings, SelectionSettings, Settings
from tests.arm.witnesses import ELBOW
from tests.arms import without_masses

SHORT = Settings(
    learning=LearningSettings(episodes=60, episode_duration=2),
    selection=SelectionSettings(every=20, trials=4, duration=2, test_trials=600),
    evaluation=EvaluationSettings(trials=8, duration=2),
)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    out = tmp_path_factory.mktemp("reproduction") / "deep" / "folder"
    return out, reproduce(out, settings=SHORT, seed=3, workers=1)


def test_the_folder_holds_every_value_and_they_belong_together(made):
    out, results = made
    values = results.files()
    assert {path.name for path in out.iterdir()} == {SWING, *values}
    assert len(values) == 10
    for name, value in values.items():
        assert type(value).load(out / name).digest == value.digest
    assert results.pendulum.fit.sha256 == read_swing(out / SWING).sha256
    inputs = read_document(out / POLICY)["provenance"]["inputs"]
    assert inputs == {"swing": results.swing.sha256}
    for recipe, simulation in ((results.default, MODEL), (results.literal, IDEAL)):
        assert recipe.policy.pendulum == results.pendulum
        assert recipe.evaluation.world == simulation
        assert recipe.twin_evaluation.world == recipe.run.conditions.world == TWIN
        for of_policy in (recipe.evaluation, recipe.twin_evaluation, recipe.run.conditions):
            assert of_policy.policy == recipe.policy.digest
    assert results.swing_up.conditions.settings.evaluation.start == "hanging"
    assert results.swing_up.conditions.world == TWIN
    assert results.literal.policy.recipe == "paper"
    assert results.literal.policy.episodes == paper.EPISODES
    assert results.default.run.conditions.actuator == shipped_actuator().digest
    assert results.literal.run.conditions.actuator == IDEAL


def test_the_simulated_pendulum_is_identified(made):
    _, results = made
    w2 = (2.0 * np.pi / paper.FREE_SWING_PERIOD) ** 2
    # Four times the half width: a chance below 1e-6, were the errors normal.
    for estimate, simulated in ((results.pendulum.w2, w2), (results.pendulum.c, SIMULATED_C)):
        assert abs(estimate.value - simulated) < 4.0 * (estimate.high - estimate.value)
    late = results.pendulum.fit.release - SIMULATED_HOLD
    assert 0.0 <= late < 1.2 * paper.FREE_SWING_PERIOD


@pytest.mark.full
def test_an_arm_with_unknown_masses_runs_on_the_model(tmp_path):
    arm = without_masses(read_urdf(ELBOW))
    results = reproduce(tmp_path, arm=arm, settings=SHORT, workers=1)
    assert results.default.run.conditions.world == MODEL
    assert results.literal.run.conditions.world == IDEAL
    assert results.default.twin_evaluation is results.literal.twin_evaluation is None
    assert "no twin" in build(results, tmp_path).read_text(encoding="utf-8")


@pytest.mark.full
def test_a_recorded_swing_is_used_and_kept(tmp_path):
    recorded = synthetic_swing(8, period=0.9)
    given = Trajectory(time=recorded.time, theta=recorded.theta, source="mine.csv")
    results = reproduce(tmp_path, swing=given, settings=SHORT, workers=1)
    assert (results.swing.source, results.simulated) == ("mine.csv", False)
    np.testing.assert_array_equal(read_swing(tmp_path / SWING).theta, given.theta)
    assert results.pendulum.period == pytest.approx(0.9, rel=1e-3)


def test_bad_input_is_refused_before_anything_is_trained(tmp_path):
    time = np.arange(0.0, 5.0, 0.01)
    still = Trajectory(time=time, theta=np.zeros_like(time), source="still.csv")
    with pytest.raises(RecordingError):
        reproduce(tmp_path, swing=still, settings=SHORT)
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(OutsideError):
        reproduce(tmp_path / "file", settings=SHORT)
    assert not (tmp_path / "policy.json").exists()
