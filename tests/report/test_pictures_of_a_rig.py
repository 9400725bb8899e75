"""What is shown of a run on a rig: what it measured, from before the release to rest."""

import numpy as np
import pytest

from equipoise.control.run_controller import PHASES
from equipoise.control.states import Phase
from equipoise.errors import ArmError, RecordingError
from equipoise.logs.conditions import RunEnd
from equipoise.logs.layout import tables
from equipoise.logs.run_log import RunLog
from equipoise.model.arms.iiwa import iiwa
from equipoise.model.arms.posture import along_x
from equipoise.report.pictures import write_video
from equipoise.report.pictures.moments import moments, span
from equipoise.report.pictures.strip import key_moments
from tests.logs.made_up import changed_table, rig_conditions

ARM = iiwa(7)
RELEASE, END = 7.0, 10.0
RESTING = 123.0
COUNTS_PER_REV = 8192


def x_at(time):
    return 0.05 * np.sin(2.0 * np.maximum(time - RELEASE, 0.0))


def phi_at(time):
    return np.radians(3.0) * np.cos(5.0 * time)


@pytest.fixture
def run():
    """Ticks of 10 ms from 1 s on, lifted until 7 s, balancing until 9 s, at rest at 10 s."""
    kinds = tables(7)
    tick = np.zeros(901, kinds["tick"])
    tick["time"] = np.arange(1.0, END + 0.005, 0.01)
    state = np.where(tick["time"] < RELEASE - 0.001, Phase.LIFTING, Phase.BALANCING)
    state[tick["time"] > 9.0 + 0.001] = Phase.STOPPING
    tick["state"] = [PHASES.index(Phase(one)) for one in state]
    tick["u"] = np.where(tick["state"] == PHASES.index(Phase.BALANCING), 1.5, np.nan)
    reply = np.zeros(901, kinds["reply"])
    reply["sent"], reply["time"] = tick["time"], tick["time"] + 0.004
    q = [ARM.with_held(q) for q in along_x(ARM, x_at(tick["time"] + 0.002))]
    reply["q"] = q
    reply["q"][7::20] = np.nan  # replies that tell torques
    reply["sent"][0] = np.nan  # the posture at the start
    encoder = np.zeros(9001, kinds["encoder"])
    encoder["time"] = np.linspace(1.0, END, 9001)
    theta = np.pi - phi_at(encoder["time"])
    counts = RESTING + (theta + 4.0 * np.pi) * COUNTS_PER_REV / (2.0 * np.pi)
    encoder["counts"] = np.round(counts)
    return RunLog(
        rig_conditions(),
        {"tick": tick, "reply": reply, "encoder": encoder},
        RunEnd(cause="lasted", zero=RESTING),
    )


def test_it_shows_what_was_measured_when_it_was(run):
    at = np.array([-1.5, 0.3, 1.1, 2.5])
    shown = moments(run, ARM, at)
    # A setpoint's way in 10 ms, seen on straight lines; half a count.
    np.testing.assert_allclose(shown.x, x_at(RELEASE + at), atol=2e-5)
    np.testing.assert_allclose(shown.phi, phi_at(RELEASE + at), atol=4e-4)
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


def test_a_run_that_did_not_get_so_far_and_another_arm_are_refused(run):
    lifting = np.full(901, PHASES.index(Phase.LIFTING))
    run = changed_table(run, "tick", state=lifting)
    with pytest.raises(RecordingError, match="ended while lifting"):
        span(run)
    with pytest.raises(ArmError, match="give the arm that ran"):
        moments(run, iiwa(14), [0.0])


@pytest.mark.usefixtures("canvas")
def test_it_is_filmed_to_the_end(run, tmp_path):
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    write_video(run, ARM, tmp_path / "run.mp4", fps=4)
    frames, seconds = ffmpeg.count_frames_and_secs(str(tmp_path / "run.mp4"))
    assert (frames, seconds) == (20, pytest.approx(5.0, abs=0.3))
