"""What is shown of a run on a rig: what it measured, from before the release to rest."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from equipoise.apps.report.pictures import write_video
from equipoise.apps.report.pictures.moments import check_span, moments, span, whole_span
from equipoise.apps.report.pictures.strip import key_moments
from equipoise.errors import ArmError, InputError, RecordingError
from equipoise.logs.conditions import RunEnd
from equipoise.model.arms.iiwa import iiwa
from equipoise.outcomes import Outcome, Phase
from equipoise.rig.run_controller import PHASES
from tests.logs.made_up import (
    RELEASE,
    balanced_on_a_rig,
    changed_table,
    phi_on_a_rig,
    x_on_a_rig,
)

ARM = iiwa(7)


@pytest.fixture
def run():
    return balanced_on_a_rig()


def test_it_shows_what_was_measured_when_it_was(run):
    at = np.array([-1.5, 0.3, 1.1, 2.5])
    shown = moments(run, ARM, at)
    # A setpoint's way in 10 ms, seen on straight lines; half a count.
    np.testing.assert_allclose(shown.x, x_on_a_rig(RELEASE + at), atol=2e-5)
    np.testing.assert_allclose(shown.phi, phi_on_a_rig(RELEASE + at), atol=4e-4)
    for q, x in zip(shown.q, shown.x, strict=True):
        assert ARM.pose(ARM.without_held(q)).position[0] == pytest.approx(
            ARM.pose(ARM.home_free).position[0] + x, abs=1e-9
        )
    assert shown.phase == ("lifting", "balancing", "balancing", "stopping")
    assert shown.captions()[0][0] == "t = −1.50 s"
    # No command is known before the release.
    np.testing.assert_allclose(shown.u, [0.0, 1.5, 1.5, 0.0])


def test_its_frames_end_where_the_balancing_ends(run):
    chosen = key_moments(run, ARM)
    assert min(chosen) == 0.0
    assert max(chosen) == pytest.approx(2.0, abs=0.03)


def test_it_begins_before_the_release_and_ends_at_rest(run):
    assert span(run) == pytest.approx((-2.0, 3.0))


def test_a_part_is_one_of_the_run(run):
    assert whole_span(run) == pytest.approx((-6.0, 3.0))
    assert check_span(run, -4.0, None) == pytest.approx((-4.0, 3.0))
    assert check_span(run, None, 0.5) == pytest.approx((-2.0, 0.5))
    for begin, end in ((-6.5, 0.0), (0.0, 3.5), (1.0, 0.5), (np.nan, 1.0), (0.0, np.inf)):
        with pytest.raises(InputError, match=r"known from -6.00 to 3.00 s; give a start"):
            check_span(run, begin, end)


def test_another_arm_is_refused(run):
    with pytest.raises(ArmError, match="give the arm that ran"):
        moments(run, iiwa(14), [0.0])


def test_a_run_that_ended_before_balancing_is_shown_from_its_first_tick(run):
    lifting = np.full(901, PHASES.index(Phase.LIFTING))
    lifted = changed_table(run, "tick", state=lifting)
    assert span(lifted) == whole_span(lifted) == pytest.approx((0.0, 9.0))
    shown = moments(lifted, ARM, [0.5, 6.3])
    np.testing.assert_allclose(shown.x, x_on_a_rig(1.0 + shown.time), atol=2e-5)
    np.testing.assert_allclose(shown.phi, phi_on_a_rig(1.0 + shown.time), atol=4e-4)
    with pytest.raises(RecordingError, match="ended while lifting"):
        key_moments(lifted, ARM)


def test_an_angle_without_a_zero_is_unknown(run):
    lifting = np.full(901, PHASES.index(Phase.LIFTING))
    lifted = replace(
        changed_table(run, "tick", state=lifting), end=RunEnd(outcome=Outcome.OPERATOR)
    )
    shown = moments(lifted, ARM, [0.5])
    assert np.isnan(shown.phi).all()
    assert shown.captions()[0][2] == "φ unknown"


def test_without_a_reply_the_commanded_posture_is_shown(run):
    q = np.tile(ARM.home, (901, 1)) + np.linspace(0.0, 0.1, 901)[:, None]
    unheard = changed_table(run, "tick", q=q)
    nothing = unheard.tables["reply"][:0]
    unheard = replace(unheard, tables=dict(unheard.tables) | {"reply": nothing})
    np.testing.assert_allclose(moments(unheard, ARM, [0.0]).q[0], q[600], atol=1e-12)


def test_a_run_without_a_tick_has_nothing_to_show(run):
    tables = dict(run.tables) | {"tick": run.tables["tick"][:0]}
    end = RunEnd(outcome=Outcome.LINK_LOST, evidence={"text": "no link"})
    with pytest.raises(RecordingError, match=r"before its first tick \(no link\)"):
        span(replace(run, tables=tables, end=end))


@pytest.mark.usefixtures("canvas")
def test_it_is_filmed_to_the_end(run, tmp_path):
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    write_video(run, ARM, tmp_path / "run.mp4", fps=4)
    frames, seconds = ffmpeg.count_frames_and_secs(str(tmp_path / "run.mp4"))
    assert (frames, seconds) == (20, pytest.approx(5.0, abs=0.3))


@pytest.mark.usefixtures("canvas")
def test_a_part_is_filmed_as_a_webp(run, tmp_path):
    write_video(run, ARM, tmp_path / "part.webp", begin=-4.0, end=-3.6)
    with Image.open(tmp_path / "part.webp") as moving:
        assert (moving.format, moving.n_frames) == ("WEBP", 5)


def test_a_webp_that_is_too_long_is_refused_before_it_is_drawn(run, tmp_path):
    time = np.linspace(1.0, 60.0, 901)
    long = changed_table(run, "tick", time=time)
    with pytest.raises(InputError, match="expected 30 s or less; choose a shorter part, or an MP4"):
        write_video(long, ARM, tmp_path / "run.webp", begin=-20.0)
    assert list(tmp_path.iterdir()) == []
