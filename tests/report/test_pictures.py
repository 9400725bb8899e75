"""Pictures: everything is where the arm and the angle say, in the frame, and in the file."""

import dataclasses
import itertools
import sys

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from equipoise import paper
from equipoise.errors import ArmError, ArtefactError, MissingExtraError, OutsideError
from equipoise.model.arms.iiwa import iiwa
from equipoise.model.arms.posture import along_x
from equipoise.model.arms.scene import SIZES
from equipoise.report.pictures import frames, rendering, strip, video, write_video
from equipoise.report.pictures.moments import moments
from equipoise.report.pictures.stage import WALL, stage
from equipoise.report.style import to_png
from equipoise.runlog import RunLog, Stream, Truth
from tests.report import made_up

ARM = iiwa(7)
SIZE = (240, 270)


@pytest.fixture(scope="module")
def policy():
    return made_up.policy(made_up.pendulum(made_up.swing()))


@pytest.fixture
def run(policy):
    return made_up.run(policy, lasted=2.0)


def at(x, arm=ARM):
    """All joints with the flange at the given displacements."""
    return np.array([arm.with_held(q) for q in along_x(arm, np.array(x))])


def pixels(picture, colour):
    """Rows and columns of what is blue, or vermilion; light and shade change the rest."""
    red, green, blue = np.moveaxis(picture.astype(int), 2, 0)
    return np.nonzero(
        {
            "blue": (blue > red + 60) & (blue > green + 30),
            "vermilion": (red > green + 60) & (green < 0.5 * red),
        }[colour]
    )


def test_pictures_have_their_size_and_differ_over_time(canvas):
    first, second = frames(ARM, at([0.0, 0.05]), np.array([0.0, 0.05]), size=SIZE)
    assert first.shape == second.shape == (270, 240, 3)
    assert first.dtype == np.uint8
    assert np.mean(np.any(first != second, axis=2)) > 0.02


def test_equal_positions_give_equal_pictures_whoever_draws_between(canvas):
    q, phi = at([0.0, 0.1]), np.array([0.1, -0.1])
    alone = list(frames(ARM, q, phi, size=SIZE))
    between = zip(
        frames(ARM, q, phi, size=SIZE),
        frames(iiwa(14), at([0.1, 0.0], iiwa(14)), phi, size=(64, 48)),
        strict=True,
    )
    np.testing.assert_array_equal(alone, [picture for picture, _ in between])
    np.testing.assert_array_equal(alone, list(frames(ARM, q, phi, size=SIZE)))


@pytest.mark.parametrize("x", [-0.2, 0.0, 0.2])
@pytest.mark.parametrize("phi", [-0.19, 0.0, 0.19])
def test_the_pendulum_is_seen_where_the_arm_carries_it(canvas, x, phi):
    q = at([x])
    (picture,) = frames(ARM, q, np.array([phi]), size=SIZE)
    flange, camera = ARM.pose(ARM.without_held(q[0])), stage(ARM, SIZE).camera
    pivot = flange.position + flange.rotation @ ARM.pivot
    column, row = camera.pixel(pivot + SIZES.rod_length * np.array([np.sin(phi), 0, np.cos(phi)]))
    rows, columns = pixels(picture, "blue")
    tip = rows < rows.min() + 4
    # The rod ends in half a ball: three pixels of it stand above the point.
    assert rows.min() == pytest.approx(row - 3.0, abs=2.0)
    assert np.mean(columns[tip]) == pytest.approx(column, abs=2.0)


def test_the_pendulum_leans_to_the_side_where_phi_is_positive(canvas):
    left, right = frames(ARM, at([0.0, 0.0]), np.array([0.1, -0.1]), size=SIZE)
    camera = stage(ARM, SIZE).camera
    # The camera looks back at the arm: +x is on the left.
    assert camera.pixel(np.array([0.1, 0.7, 0.5])) < camera.pixel(np.array([-0.1, 0.7, 0.5]))
    assert np.mean(pixels(left, "blue")[1]) < np.mean(pixels(right, "blue")[1]) - 3.0


def test_the_posts_stand_where_the_track_ends(canvas):
    scene = stage(ARM, SIZE)
    assert [post.x for post in scene.posts] == [-paper.X_LIMIT, paper.X_LIMIT]
    (picture,) = frames(ARM, at([0.0]), np.zeros(1), size=SIZE)
    seen = set(zip(*pixels(picture, "vermilion"), strict=True))
    for post, q in zip(scene.posts, at([-paper.X_LIMIT, paper.X_LIMIT]), strict=True):
        flange = ARM.pose(ARM.without_held(q))
        pivot = flange.position + flange.rotation @ ARM.pivot
        np.testing.assert_allclose([*post.top[:2]], pivot[:2], atol=1e-6)
        assert post.top[2] > pivot[2]
        column, row = scene.camera.pixel(0.5 * (post.foot + post.top))
        assert (int(row), int(column)) in seen


@pytest.mark.parametrize("size", [(240, 270), (320, 240), (200, 400)])
@pytest.mark.parametrize("arm", [iiwa(7), iiwa(14, media_flange=0.061)], ids=lambda arm: arm.name)
def test_only_the_table_leaves_the_picture(canvas, arm, size):
    limit = np.radians(paper.PHI_LIMIT_DEG)
    q = at([-paper.X_LIMIT, 0.0, paper.X_LIMIT], arm)
    wall = np.rint(255.0 * np.array(WALL))
    for picture in frames(arm, q, np.array([-limit, 0.0, limit]), size=size):
        border = np.concatenate([picture[0], picture[:, 0], picture[:, -1]]).astype(float)
        is_wall = np.all(np.abs(border - wall) <= 1.0, axis=1)
        is_table = border[:, 0] > border[:, 2] + 15.0
        assert np.all(is_wall[: size[0]])
        # Each edge of the table may share a pixel with the wall.
        assert np.sum(~(is_wall | is_table)) <= 4
        rows, columns = np.nonzero(np.any(np.abs(picture - wall) > 1.0, axis=2))
        # It fills the picture, at least one way.
        assert max(np.ptp(rows) / size[1], np.ptp(columns) / size[0]) > 0.9


@pytest.mark.parametrize(("q", "phi"), [((3, 6), 3), ((3, 7), 2), ((7,), 1)])
def test_positions_of_another_shape_are_refused(q, phi):
    with pytest.raises(ArmError, match="give all joints of iiwa7, one row for each angle"):
        frames(ARM, np.zeros(q), np.zeros(phi), size=SIZE)


def test_a_machine_without_opengl_is_told_what_to_install(monkeypatch):
    monkeypatch.setattr(rendering, "find_library", lambda _: None)
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    with pytest.raises(OutsideError, match="neither a library EGL nor OSMesa; install EGL"):
        next(frames(ARM, at([0.0]), np.zeros(1), size=SIZE))


def test_a_context_that_cannot_be_opened_is_an_error_of_ours(monkeypatch):
    monkeypatch.setattr(rendering, "_backend", lambda: "equipoise.paper")
    with pytest.raises(OutsideError, match="equipoise.paper says"):
        next(frames(ARM, at([0.0]), np.zeros(1), size=SIZE))


def test_moments_lie_on_straight_lines_between_the_ticks(run):
    shown = moments(run, ARM, [0.5, 0.505, 9.0])
    np.testing.assert_allclose(shown.x, [run.x[50], 0.5 * (run.x[50] + run.x[51]), run.x[-1]])
    np.testing.assert_allclose(shown.phi[1], 0.5 * (run.phi[50] + run.phi[51]))
    np.testing.assert_allclose(shown.q[1], 0.5 * (run.q[50] + run.q[51]))


def test_the_truth_is_shown_where_it_is_known(run):
    truth = Truth(run.x - 0.01, run.x_dot, run.phi + 0.1, run.phi_dot, run.q + 0.2)
    shown = moments(dataclasses.replace(run, truth=truth), ARM, [0.5])
    assert shown.x[0] == pytest.approx(run.x[50] - 0.01)
    assert shown.phi[0] == pytest.approx(run.phi[50] + 0.1)
    np.testing.assert_allclose(shown.q[0], run.q[50] + 0.2)


def test_captions_are_signed_and_in_degrees(run):
    truth = Truth(*(np.full_like(run.x, v) for v in (-0.0301, 0.0, np.radians(1.26), 0.0)), run.q)
    shown = moments(dataclasses.replace(run, truth=truth), ARM, [0.5])
    assert shown.captions() == [("t = 0.50 s", "x = −0.030 m", "φ = +1.3°")]


def test_a_zero_has_no_sign(run):
    truth = Truth(*np.full((4, len(run.x)), -1e-5), run.q)
    shown = moments(dataclasses.replace(run, truth=truth), ARM, [0.5])
    assert shown.captions() == [("t = 0.50 s", "x = 0.000 m", "φ = 0.0°")]


def test_a_run_of_another_arm_is_refused(run):
    with pytest.raises(ArmError, match="one of iiwa7, not of iiwa14; give the arm that ran"):
        strip(run, iiwa(14))


def test_a_run_in_which_no_policy_ran_is_refused(run):
    excited = Stream(np.zeros(1), np.array([ARM.home]))
    with pytest.raises(ArtefactError, match="no ticks"):
        strip(RunLog.of_excitation(run.conditions, excited, run.replies), ARM)


def test_the_strip_shows_the_first_seconds_as_many_as_the_papers(canvas, policy):
    figure = strip(made_up.run(policy), ARM)
    titles = [panel.get_title(loc="left") for panel in figure.axes]
    assert titles == [f"t = {t:.2f} s" for t in np.linspace(0.0, paper.SECONDS_BALANCED, 8)]


def test_the_strip_of_a_short_run_ends_with_it(canvas, policy):
    figure = strip(made_up.run(policy, lasted=1.3, cause="track"), ARM)
    assert figure.axes[-1].get_title(loc="left") == "t = 1.30 s"


def test_the_strip_draws_the_run_at_its_times(canvas, run):
    times = [0.2, 0.8, 1.4]
    figure = strip(run, ARM, times)
    shown = moments(run, ARM, times)
    drawn = [panel.images[0] for panel in figure.axes if panel.images]
    assert len(drawn) == 3
    height, width = drawn[0].get_array().shape[:2]
    again = frames(ARM, shown.q, shown.phi, size=(width, height))
    for image, picture in zip(drawn, again, strict=True):
        np.testing.assert_array_equal(image.get_array(), picture)


def test_the_strip_cuts_nothing_off_and_covers_nothing(canvas, run):
    figure = strip(run, ARM)
    artist = FigureCanvasAgg(figure)
    artist.draw()
    renderer = artist.get_renderer()
    page = figure.bbox.padded(3.0)
    boxes = [panel.get_tightbbox(renderer) for panel in figure.axes]
    boxes += [part.get_window_extent(renderer) for part in (figure._suptitle, figure._supxlabel)]
    for box in boxes:
        assert page.contains(box.x0, box.y0)
        assert page.contains(box.x1, box.y1)
    for one, other in itertools.combinations(boxes, 2):
        assert not one.overlaps(other)


def test_equal_runs_give_equal_strips(canvas, run):
    assert to_png(strip(run, ARM, [0.5])) == to_png(strip(run, ARM, [0.5]))


@pytest.fixture
def ffmpeg():
    return pytest.importorskip("imageio_ffmpeg", reason="the extra `video` is not installed")


@pytest.fixture
def small(monkeypatch):
    monkeypatch.setattr(video, "FRAME", (480, 368))


def test_a_video_lasts_as_long_as_its_run_and_shows_it(canvas, ffmpeg, small, run, tmp_path):
    path, done = tmp_path / "deep" / "run.mp4", []
    write_video(run, ARM, path, fps=10, report=done.append)
    assert ffmpeg.count_frames_and_secs(path) == (20, pytest.approx(2.0, abs=0.01))
    reader = ffmpeg.read_frames(path)
    meta = next(reader)
    assert (meta["codec"], meta["size"], meta["fps"]) == ("h264", (480, 368), 10.0)
    assert meta["pix_fmt"].startswith("yuv420p")
    shown = moments(run, ARM, np.arange(20) / 10)
    drawn = np.array(list(frames(ARM, shown.q, shown.phi, size=(480, 368))), np.int16)
    pendulum = slice(60, 200), slice(230, 480)  # beside the captions
    for number, frame in enumerate(reader):
        picture = np.frombuffer(frame, np.uint8).reshape(368, 480, 3)
        difference = np.abs(drawn - picture)[:, *pendulum].mean(axis=(1, 2, 3))
        assert np.argmin(difference) == number
        assert difference[number] < 4.0  # of 255: compression blurs edges
    assert done == pytest.approx(np.arange(1, 21) / 20)
    assert list(path.parent.iterdir()) == [path]


def test_captions_are_written_over_the_picture(canvas, ffmpeg, run):
    shown, scene = moments(run, ARM, [0.5, 1.0]), stage(ARM, video.FRAME)
    plain = list(rendering.draw(scene, shown.q, shown.phi))
    first, second = video._written_on(plain, scene, shown, "iiwa7 · model")
    changed = np.any(first != plain[0], axis=2)
    assert 0.005 < np.mean(changed) < 0.05
    # Time, displacement and angle at the top left, where there is wall.
    corner = (slice(0, 150), slice(0, 240))
    assert np.any(changed[corner])
    assert np.any(first[corner] != second[corner])


def test_an_encoder_that_fails_leaves_no_file(canvas, ffmpeg, small, run, tmp_path, monkeypatch):
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", "/bin/false")
    with pytest.raises(OutsideError, match=r"cannot write .*run\.mp4"):
        write_video(run, ARM, tmp_path / "run.mp4", fps=2)
    assert list(tmp_path.iterdir()) == []


def test_a_drawing_that_fails_leaves_no_file(ffmpeg, run, tmp_path, monkeypatch):
    monkeypatch.setattr(rendering, "_backend", lambda: "equipoise.paper")
    with pytest.raises(OutsideError, match="cannot draw pictures"):
        write_video(run, ARM, tmp_path / "run.mp4")
    assert list(tmp_path.iterdir()) == []


def test_without_the_extra_its_name_is_told(run, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(MissingExtraError, match=r"pip install imageio-ffmpeg \(or '\.\[video\]'"):
        write_video(run, ARM, tmp_path / "run.mp4")
