"""Reproduction: every stage, one after the other, and what it leaves."""

from contextlib import contextmanager

import numpy as np
import pytest

from equipoise import paper
from equipoise.apps.report.page import build
from equipoise.artefacts import read_document
from equipoise.errors import ArtefactError, OutsideError, RecordingError
from equipoise.identification import identify
from equipoise.learning.training import LEARNERS
from equipoise.model.actuator import shipped_actuator
from equipoise.model.arms.urdf import read_urdf
from equipoise.model.worlds import MODEL
from equipoise.outcomes import Outcome
from equipoise.settings import resolve
from equipoise.studies import gap as study
from equipoise.studies.gap_results import CURED, PAPER
from equipoise.studies.reproduction import (
    QUICK,
    QUICK_GAP,
    reproduce,
    shortened,
    unfinished_path,
)
from equipoise.studies.results import GAP, RECORD, RUN, SWING, load, verdict
from equipoise.studies.synthetic_swing import SyntheticSwing, synthetic_swing
from equipoise.trajectory import Trajectory
from tests.arms import without_masses
from tests.model.arms.witnesses import ELBOW

pytestmark = pytest.mark.compiled_only
SHORT = resolve(
    overrides=[
        "learning.episodes=60",
        "learning.episode_duration=2",
        "selection.every=20",
        "selection.round_trials=8",
        "selection.rounds=2",
        "selection.duration=2",
        "selection.candidates=2",
        "selection.test_trials=600",
        "evaluation.trials=8",
        "evaluation.duration=2",
    ]
)
FILES = ("swing.csv", "pendulum.json", "policy.json", "evaluation.json", "run.mcap", "gap.json")


@contextmanager
def tiny_gap():
    """The study of the gap has tests of its own: here two trials of a tenth of a second do."""
    quickly = [*study.BEST_TABLE_QUICK, "learning.episodes=40", "selection.every=20"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(study, "SHORT", study.SHORT._replace(trials=2, duration=0.1))
        patch.setattr(study, "BEST_TABLE_QUICK", quickly)
        yield


@pytest.fixture
def with_tiny_gap():
    with tiny_gap():
        yield


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    told = []
    out = tmp_path_factory.mktemp("reproduction") / "deep" / "folder"
    with tiny_gap():
        made = reproduce(out, settings=SHORT, seed=3, workers=1, report=told.append)
    return made, told


def test_it_leaves_every_value_and_they_belong_together(made):
    made, _ = made
    assert sorted(path.name for path in made.out.iterdir()) == sorted([*FILES, RECORD])
    results = load(made.out)
    assert verdict(results) == made.verdict
    assert results.policy.digest == made.results.policy.digest
    assert results.run.digest == made.results.run.digest
    assert results.evaluation.policy == results.policy.digest == results.run.conditions.policy
    assert results.policy.pendulum == results.pendulum
    assert results.pendulum.fit.sha256 == results.swing.sha256
    assert results.gap.digest == made.results.gap.digest
    assert results.gap.policy == results.policy.digest


def test_each_file_names_what_it_was_made_from(made):
    made, _ = made
    results = made.results
    inputs = {
        "pendulum.json": {"swing": results.swing.sha256},
        "policy.json": {"pendulum": results.pendulum.digest},
        "evaluation.json": {"policy": results.policy.digest},
        "gap.json": {"policy": results.policy.digest},
    }
    for name, expected in inputs.items():
        assert read_document(made.out / name)["provenance"]["inputs"] == expected


def test_the_stages_are_told_as_they_go(made):
    made, told = made
    stages = ["swing", "identify", "train", "evaluate", "deploy", "gap"]
    assert [stage.name for stage in made.results.record.stages] == stages
    shown = list(dict.fromkeys(p.stage for p in told))
    assert shown == [
        *("swing", "identify", "compile", "train", "select", "test", "learners", "evaluate"),
        *("compile twin", "deploy", "gap", "train paper", "select paper"),
    ]
    for stage in shown:
        # Learners and trials report from their own threads; a stage that has ended stays so.
        shares = [p.share for p in told if p.stage == stage]
        assert shares[0] == 0.0
        assert 1.0 in shares
        shares = shares[: shares.index(1.0)]
        # A failure in a test adds to the trials that it needs.
        assert shares == sorted(shares) or stage == "test"
    whole = {p.stage: (p.total, p.unit) for p in told if p.unit}
    assert whole["train"] == (60, "episodes")
    assert whole["learners"] == (LEARNERS - 1, "learners")
    assert whole["evaluate"] == (40, "trials")  # eight for the policy and each yardstick


@pytest.mark.parametrize(
    "at",
    [
        pytest.param("train", marks=pytest.mark.slow),
        "select",
        pytest.param("evaluate", marks=pytest.mark.slow),
        pytest.param("train paper", marks=pytest.mark.slow),
        pytest.param("gap", marks=pytest.mark.slow),
    ],
)
@pytest.mark.usefixtures("with_tiny_gap")
def test_an_interrupted_reproduction_goes_on_to_the_same_files(made, tmp_path, at):
    made, _ = made

    def interrupt(progress):
        if progress.stage == at and 0.0 < progress.share < 1.0:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        reproduce(tmp_path, settings=SHORT, seed=3, workers=1, report=interrupt)
    assert not (tmp_path / RECORD).exists()
    assert unfinished_path(tmp_path).exists()
    with pytest.raises(ArtefactError, match="with another seed;"):
        reproduce(tmp_path, settings=SHORT, seed=4, workers=1)
    told = []
    again = reproduce(tmp_path, settings=SHORT, seed=3, workers=2, report=told.append)
    assert again.results.record.files == made.results.record.files
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([*FILES, RECORD])
    before = {p.stage for p in told if p.text == "done before the interruption"}
    done = {"train": 1, "select": 1, "evaluate": 2, "train paper": 4, "gap": 4}[at]
    assert before == set(("identify", "train", "evaluate", "deploy")[:done])


@pytest.mark.usefixtures("with_tiny_gap")
def test_a_file_that_changed_since_the_interruption_is_made_again(made, tmp_path):
    made, _ = made

    def interrupt(progress):
        if progress.stage == "evaluate":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        reproduce(tmp_path, settings=SHORT, seed=3, workers=1, report=interrupt)
    (tmp_path / "pendulum.json").write_text("edited")
    again = reproduce(tmp_path, settings=SHORT, seed=3, workers=1)
    assert again.results.record.files == made.results.record.files


def test_the_simulated_pendulum_is_found_again(made):
    made, _ = made
    w2 = (2.0 * np.pi / paper.FREE_SWING_PERIOD) ** 2
    pendulum, swing = made.results.pendulum, made.results.record.simulated
    # Four times the half width: a chance below 1e-6, were the errors normal.
    for estimate, truth in ((pendulum.w2, w2), (pendulum.c, swing.c)):
        assert abs(estimate.value - truth) < 4.0 * (estimate.high - estimate.value)
    assert swing.hold <= pendulum.fit.release < swing.hold + 0.5 * swing.period
    assert pendulum.fit.warnings == ()


def test_the_run_is_on_the_twin_and_as_long_as_the_trials(made):
    made, _ = made
    run = made.results.run
    assert run.conditions.duration == SHORT.evaluation.duration
    assert run.conditions.world == "twin:nominal"
    assert run.conditions.actuator == shipped_actuator().digest
    assert len(run.stream.time) == 2 * len(run.time)
    assert made.results.evaluation.world == MODEL


def test_the_gap_is_the_short_one_of_the_same_twin(made):
    made, told = made
    gap = made.results.gap
    assert gap.quick
    assert gap.world == "twin:nominal"
    with tiny_gap():
        trials = study.trials_of(quick=True)
    assert any((p.completed, p.unit) == (trials, "trials") for p in told if p.stage == "gap")


def test_an_arm_whose_masses_are_not_known_runs_on_the_model(tmp_path):
    made = reproduce(tmp_path, arm=without_masses(read_urdf(ELBOW)), settings=SHORT, workers=1)
    results = load(tmp_path)
    assert results.run.conditions.world == MODEL
    assert results.gap is None
    assert not (tmp_path / GAP).exists()
    assert "no digital twin of the elbow 6" in made.verdict[2]


def test_a_policy_of_the_paper_runs_on_the_twin_without_a_study_of_its_cures(tmp_path):
    bare = resolve("paper", overrides=["learning.episodes=40", "evaluation.trials=4"])
    results = reproduce(tmp_path, settings=bare, workers=1).results
    assert results.policy.actuator.kind == "ideal"
    assert results.run.conditions.world == "twin:nominal"
    assert results.gap is None


@pytest.mark.usefixtures("with_tiny_gap")
def test_the_results_do_not_depend_on_the_number_of_workers(made, tmp_path):
    made, _ = made
    again = reproduce(tmp_path, settings=SHORT, seed=3, workers=2)
    assert again.results.record.files == made.results.record.files


@pytest.mark.usefixtures("with_tiny_gap")
def test_a_recorded_swing_is_used_and_kept(tmp_path):
    recorded = synthetic_swing(SyntheticSwing(period=0.9), seed=8)
    given = Trajectory(time=recorded.time, theta=recorded.theta, source="mine.csv")
    made = reproduce(tmp_path, swing=given, settings=SHORT, workers=1)
    record = made.results.record
    assert (record.swing, record.swing_sha256) == ("mine.csv", given.sha256)
    assert record.simulated is None
    np.testing.assert_array_equal(load(tmp_path).swing.theta, given.theta)
    assert made.results.pendulum.period == pytest.approx(0.9, rel=1e-3)
    assert made.verdict[3].startswith("The recorded free swing has a period of 0.9")


def test_a_swing_that_identifies_nothing_is_refused(tmp_path):
    time = np.arange(0.0, 5.0, 0.01)
    still = Trajectory(time=time, theta=np.zeros_like(time), source="still.csv")
    with pytest.raises(RecordingError, match=r"still\.csv"):
        reproduce(tmp_path, swing=still, settings=SHORT)


def test_a_folder_that_cannot_be_made_is_refused_before_anything_is_trained(tmp_path):
    (tmp_path / "file").write_text("in the way")
    told = []
    with pytest.raises(OutsideError):
        reproduce(tmp_path / "file", settings=SHORT, report=told.append)
    assert "train" not in [p.stage for p in told]


def test_a_mixed_folder_is_refused(made, tmp_path):
    made, _ = made
    for path in made.out.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    with (tmp_path / SWING).open("a") as file:
        file.write("99.0,0.1\n")
    with pytest.raises(ArtefactError, match=r"swing\.csv is not the file"):
        load(tmp_path)


def test_quick_only_shortens():
    full, short = resolve(), shortened(resolve())
    for name, value in QUICK.items():
        section, _, key = name.partition(".")
        assert getattr(getattr(short, section), key) == value
        assert getattr(getattr(full, section), key) > value
    assert shortened(SHORT) == SHORT


def test_the_hand_of_the_simulated_swing_holds_and_lets_go():
    swing = SyntheticSwing()
    recording = synthetic_swing(swing, seed=1)
    held = recording.time < swing.hold
    assert np.ptp(recording.theta[held]) < 4.0 * swing.tremor
    assert np.ptp(recording.theta[held]) > swing.tremor
    # IntArray counts, and no jump at the release.
    counts = recording.theta / recording.resolution
    np.testing.assert_allclose(counts, np.round(counts), atol=1e-6)
    assert np.max(np.abs(np.diff(recording.theta))) < 0.02
    assert not recording.released
    assert not np.array_equal(synthetic_swing(swing, seed=2).theta, recording.theta)


def test_a_swing_without_a_hand_is_identified_from_its_first_sample():
    recording = synthetic_swing(SyntheticSwing(hold=0.0, noise=0.0))
    assert recording.time[0] == 0.0
    assert identify(recording).fit.release is None


@pytest.mark.usefixtures("with_tiny_gap")
def test_a_quick_look_cuts_the_gap_down_further(tmp_path, monkeypatch):
    monkeypatch.setattr("equipoise.studies.reproduction.QUICK_GAP", (2, 0.05))
    made = reproduce(tmp_path, settings=SHORT, workers=1, quick=True)
    assert made.results.gap.duration == 0.05


@pytest.mark.slow
def test_quick_and_the_page_work_as_they_come(tmp_path):
    made = reproduce(tmp_path, quick=True)
    summary = made.results.evaluation.results.summary()
    assert summary.trials == QUICK["evaluation.trials"]
    # Worse than half is worse than any of 20 seeds showed.
    assert summary.rate > 0.5
    assert made.results.run.outcome == Outcome.LASTED
    gap = made.results.gap
    assert (gap.trials, gap.duration) == QUICK_GAP
    # Most of the trials on the twin stand, and without the cures fewer do.
    (cured,) = [p for p in gap.curve("delay", CURED) if p.at == gap.world_settings.transport]
    assert np.mean(cured.results.survival) > 0.9 * gap.duration
    assert np.mean(gap.point("world", PAPER).results.survival) < 0.5 * gap.duration
    assert build(tmp_path).stat().st_size > 100_000
    assert (tmp_path / RUN).stat().st_size > 100_000
