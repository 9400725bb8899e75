"""Pictures: everything is where the arm and the angle say, in the frame, and in the file."""

import io
import itertools
import sys

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from PIL import Image

from equipoise import paper
from equipoise.apps.report.pictures import animation, rendering, strip, video, write_video
from equipoise.apps.report.pictures.film import BAR, FPS
from equipoise.apps.report.pictures.moments import moments
from equipoise.apps.report.pictures.scene import stage
from equipoise.apps.report.pictures.strip import key_moments
from equipoise.errors import ArmError, MissingExtraError, OutsideError, RecordingError
from equipoise.logs.run_log import RunLog
from equipoise.model.arms.iiwa import iiwa
from equipoise.model.arms.posture import along_x
from equipoise.model.arms.scene import SIZES
from equipoise.outcomes import Outcome
from tests.apps.report import made_up
from tests.apps.report.made_up import frames
from tests.logs.made_up import changed_table

ARM = iiwa(7)
SIZE = (240, 270)
strip_module = sys.modules[key_moments.__module__]  # its function has the same name
U_AT_50 = "u = −2.0 m/s²"
"""Command of the made-up run at 0.5 s."""


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
    """Rows and columns of what is blue, vermilion or green; light and shade change the rest."""
    red, green, blue = np.moveaxis(picture.astype(int), 2, 0)
    return np.nonzero(
        {
            "blue": (blue > red + 60) & (blue > green + 30),
            "vermilion": (red > green + 60) & (green < 0.5 * red),
            "green": (green > red + 40) & (green > blue + 15),
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


def test_x_and_phi_are_positive_to_the_right(canvas):
    right, left = frames(ARM, at([0.1, -0.1]), np.array([0.1, -0.1]), size=SIZE)
    assert np.mean(pixels(right, "blue")[1]) > np.mean(pixels(left, "blue")[1]) + 10.0
    right, left = frames(ARM, at([0.0, 0.0]), np.array([0.1, -0.1]), size=SIZE)
    assert np.mean(pixels(right, "blue")[1]) > np.mean(pixels(left, "blue")[1]) + 2.0


def test_an_arrow_is_as_long_as_u_and_points_where_it_pushes(canvas):
    u = np.array([2.0, -2.0, 1.0])
    pictures = list(frames(ARM, at([0.0] * 3), np.zeros(3), u, size=SIZE))
    camera, pivot = stage(ARM, SIZE).camera, pivot_at(at([0.0])[0])
    for picture, push in zip(pictures, u, strict=True):
        columns = pixels(picture, "green")[1]
        ends = [camera.pixel(pivot + np.array([0.1 * far, 0.0, -0.09]))[0] for far in (0, push)]
        # The shaft's own width sticks out, on both sides.
        assert [columns.min(), columns.max()] == pytest.approx(sorted(ends), abs=4.0)
    (without,) = frames(ARM, at([0.0]), np.zeros(1), size=SIZE)
    assert not len(pixels(without, "green")[0])


def test_the_shadow_of_the_pivot_lies_on_the_rail(canvas):
    scene, (q,) = stage(ARM, SIZE), at([0.07])
    (picture,), (elsewhere,) = (frames(ARM, at([x]), np.zeros(1), size=SIZE) for x in (0.07, -0.1))
    # Of the bracket: the rail is drawn over that of the pivot itself.
    foot = pivot_at(q) * [1.0, 1.0, 0.0] - [0.0, 0.05, 0.0]
    column, row = (round(place) for place in scene.camera.pixel(foot))
    assert elsewhere[row, column].mean() > picture[row, column].mean() + 30.0


def pivot_at(q):
    flange = ARM.pose(ARM.without_held(q))
    return flange.position + flange.rotation @ ARM.pivot


def test_the_posts_stand_where_the_track_ends_as_high_as_the_pendulum(canvas):
    scene = stage(ARM, SIZE)
    assert [post.x for post in scene.posts] == [-paper.X_LIMIT, paper.X_LIMIT]
    (picture,) = frames(ARM, at([0.0]), np.zeros(1), size=SIZE)
    seen = set(zip(*pixels(picture, "vermilion"), strict=True))
    for post, q in zip(scene.posts, at([-paper.X_LIMIT, paper.X_LIMIT]), strict=True):
        pivot = pivot_at(q)
        np.testing.assert_allclose([*post.top[:2]], pivot[:2], atol=1e-6)
        assert post.top[2] > pivot[2] + SIZES.rod_length
        for share in (0.3, 0.95):
            column, row = scene.camera.pixel(post.foot + share * (post.top - post.foot))
            assert (int(row), int(column)) in seen


@pytest.mark.parametrize("size", [(320, 240), (200, 400)])
@pytest.mark.parametrize("arm", [iiwa(7), iiwa(14, media_flange=0.061)], ids=lambda arm: arm.name)
def test_what_moves_and_the_posts_stay_in_the_picture(canvas, arm, size):
    limit = np.radians(paper.PHI_LIMIT_DEG)
    q = at([-paper.X_LIMIT, 0.0, paper.X_LIMIT], arm)
    left, middle, right = frames(arm, q, np.array([-limit, 0.0, limit]), size=size)
    moves = np.any(left != middle, axis=2) | np.any(right != middle, axis=2)
    # The shadow of the shoulder may leave the table's part that is seen.
    brown = np.all([p[..., 0] > p[..., 2] + 15.0 for p in (left, middle, right)], axis=0)
    for border in (np.s_[0], np.s_[-1], np.s_[:, 0], np.s_[:, -1]):
        assert not np.any(moves[border] & ~brown[border])
    scene = stage(arm, size)
    tops = [scene.camera.pixel(post.top) for post in scene.posts]
    assert all(0.0 < column < size[0] and 0.0 < row < size[1] for column, row in tops)
    # The rig fills the picture, at least one way.
    rows, columns = np.nonzero(moves)
    places = [*tops, *(scene.camera.pixel(post.foot) for post in scene.posts)]
    width = max(columns.max(), *(c for c, _ in places)) - min(
        columns.min(), *(c for c, _ in places)
    )
    height = max(r for _, r in places) - min(rows.min(), *(r for _, r in places))
    assert max(width / size[0], height / size[1]) > 0.6


def test_a_machine_without_opengl_is_told_what_to_install(monkeypatch):
    monkeypatch.setattr(rendering, "find_library", lambda _: None)
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    with pytest.raises(
        OutsideError, match="neither library EGL nor OSMesa is installed; install EGL"
    ):
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
    # A command stands until the next one.
    np.testing.assert_array_equal(shown.u, run.u[[50, 50, -1]])


def test_the_truth_is_shown_where_it_is_known(run):
    real = changed_table(run, "truth", x=run.x - 0.01, phi=run.phi + 0.1, q=run.q + 0.2)
    shown = moments(real, ARM, [0.5])
    assert shown.x[0] == pytest.approx(run.x[50] - 0.01)
    assert shown.phi[0] == pytest.approx(run.phi[50] + 0.1)
    np.testing.assert_allclose(shown.q[0], run.q[50] + 0.2)


def test_captions_are_signed_and_in_degrees(run):
    x, phi = np.full_like(run.x, -0.0301), np.full_like(run.x, np.radians(1.26))
    shown = moments(changed_table(run, "truth", x=x, phi=phi, q=run.q), ARM, [0.5])
    assert shown.captions() == [("t = 0.50 s", "x = −0.030 m", "φ = +1.3°", U_AT_50)]


def test_a_zero_has_no_sign(run):
    nearly = np.full(len(run.x), -1e-5)
    shown = moments(changed_table(run, "truth", x=nearly, phi=nearly, q=run.q), ARM, [0.5])
    assert shown.captions() == [("t = 0.50 s", "x = 0.000 m", "φ = 0.0°", U_AT_50)]


def test_a_run_of_another_arm_is_refused(run):
    with pytest.raises(ArmError, match="one of iiwa7, not of iiwa14; give the arm that ran"):
        strip(run, iiwa(14))


def test_a_run_in_which_no_policy_ran_is_refused(run):
    excited = {"time": np.zeros(1), "q": np.array([ARM.home])}
    with pytest.raises(RecordingError, match="no policy ran"):
        strip(RunLog.simulated(run.conditions, run.end, {}, stream=excited), ARM)


def test_the_strip_shows_the_moments_that_differ(canvas, run, monkeypatch):
    monkeypatch.setattr(strip_module, "FRAME", (64, 64))
    figure = strip(run, ARM)
    # The run of `made_up` is a sine of a period of 6.3 s in x, of 0.8 s in phi, for 2 s.
    titles = [panel.get_title(loc="left") for panel in figure.axes if panel.images]
    assert [title.split(",")[0] for title in titles] == [
        "release",
        "largest lean right",
        "largest lean left",
        "furthest right",
        "end",
    ]
    times = [float(title.split("= ")[1].removesuffix(" s")) for title in titles]
    right, left = np.pi / 16 + np.pi / 4, 3 * np.pi / 16 + np.pi / 4  # the second and third lean
    assert times == pytest.approx([0.0, right, left, np.pi / 2, 2.0], abs=0.02)
    shown = moments(run, ARM, list(key_moments(run, ARM)))
    drawn = [panel.images[0].get_array() for panel in figure.axes if panel.images]
    np.testing.assert_array_equal(
        drawn, list(frames(ARM, shown.q, shown.phi, shown.u, size=(64, 64)))
    )
    below = [panel.texts[0].get_text() for panel in figure.axes if panel.images]
    assert below == ["  ".join(caption[1:]) for caption in shown.captions()]


def test_the_strip_of_one_step_is_its_beginning_and_end(canvas, policy, monkeypatch):
    monkeypatch.setattr(strip_module, "FRAME", (64, 64))
    assert list(key_moments(made_up.run(policy, lasted=0.01, cause=Outcome.ANGLE), ARM)) == [
        0.0,
        0.01,
    ]


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


def test_an_animation_is_the_run_at_its_speed_with_its_numbers(canvas, run):
    size, told = (96, 96), []
    made = animation(run, ARM, size=size, end=0.4, report=told.append)
    assert told == pytest.approx([0.2, 0.4, 0.6, 0.8, 1.0])
    shown = moments(run, ARM, np.arange(5) / FPS)
    drawn = np.array(list(frames(ARM, shown.q, shown.phi, shown.u, size=(96, 86))), np.int16)
    with Image.open(io.BytesIO(made.webp)) as moving:
        assert (moving.format, moving.size, moving.n_frames) == ("WEBP", size, 5)
        for number in range(5):
            moving.seek(number)
            picture = np.asarray(moving.convert("RGB"))
            difference = np.abs(drawn - picture[:86]).mean(axis=(1, 2, 3))
            assert np.argmin(difference) == number
            # Time, displacement, angle and command stand below.
            assert picture[86:].min() < 128
            # The last one stands a while before the first comes again.
            assert moving.info["duration"] == (80 if number < 4 else 1000)
        assert moving.info["loop"] == 0
    with Image.open(io.BytesIO(made.still)) as still:
        assert (still.format, still.size, getattr(still, "n_frames", 1)) == ("WEBP", size, 1)
    assert animation(run, ARM, size=size, end=0.4) == made


@pytest.fixture
def ffmpeg():
    return pytest.importorskip("imageio_ffmpeg", reason="the extra `video` is not installed")


@pytest.fixture
def small(monkeypatch):
    monkeypatch.setattr(video, "FRAME", (240, 176))


def test_a_video_lasts_as_long_as_its_run_and_shows_it(canvas, ffmpeg, small, run, tmp_path):
    path, done = tmp_path / "deep" / "run.mp4", []
    write_video(run, ARM, path, fps=10, report=done.append)
    assert ffmpeg.count_frames_and_secs(path) == (20, pytest.approx(2.0, abs=0.01))
    reader = ffmpeg.read_frames(path)
    meta = next(reader)
    assert (meta["codec"], meta["size"], meta["fps"]) == ("h264", (240, 176), 10.0)
    assert meta["pix_fmt"].startswith("yuv420p")
    shown = moments(run, ARM, np.arange(20) / 10)
    above = video.FRAME[0], video.FRAME[1] - round(BAR * video.FRAME[1])
    drawn = np.array(list(frames(ARM, shown.q, shown.phi, shown.u, size=above)), np.int16)
    pendulum = slice(0, above[1] // 2), slice(None)  # above the labels of the posts
    for number, frame in enumerate(reader):
        picture = np.frombuffer(frame, np.uint8).reshape(*video.FRAME[::-1], 3)[: above[1]]
        difference = np.abs(drawn - picture)[:, *pendulum].mean(axis=(1, 2, 3))
        assert np.argmin(difference) == number
        assert difference[number] < 4.0  # of 255: compression blurs edges
    assert done == pytest.approx(np.arange(1, 21) / 20)
    assert list(path.parent.iterdir()) == [path]


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
