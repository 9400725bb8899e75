"""Pictures and films: everything is where arm and angle say, in the frame, and in the file."""

import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from equipoise import film, iiwa
from equipoise.arm.posture import along_x
from equipoise.arm.scene import SIZES
from equipoise.errors import InputError, MissingExtraError, OutsideError
from equipoise.film import RigRenderer, build_scene, camera_axes, write_film
from equipoise.log.motion import Motion
from tests.log.made_up import balanced_on_a_rig, changed_table

ARM = iiwa(7)
WIDTH, HEIGHT = 240, 270


@pytest.fixture(scope="session")
def renderer():
    """Skips where there is no OpenGL."""
    try:
        return RigRenderer(ARM, WIDTH, HEIGHT)
    except OutsideError as error:
        return pytest.skip(str(error))


@pytest.fixture(scope="module")
def run():
    return balanced_on_a_rig()


def pixel(point):
    """Column and row of a point, by the pinhole camera of a textbook."""
    rig = build_scene(ARM)
    right, up, ahead = camera_axes() @ (point - rig.target)
    scale = 0.5 * HEIGHT / (np.tan(np.radians(10.0)) * (rig.distance(WIDTH / HEIGHT) + ahead))
    return 0.5 * WIDTH + scale * right, 0.5 * HEIGHT - scale * up


def blue_pixels(picture):
    """Rows and columns of the pendulum; light and shade change the rest."""
    red, green, blue = np.moveaxis(picture.astype(int), 2, 0)
    return np.nonzero((blue > red + 60) & (blue > green + 30))


@pytest.mark.parametrize(("x", "phi"), [(-0.2, 0.19), (0.2, -0.19)])
def test_the_pendulum_is_seen_where_the_arm_carries_it(renderer, x, phi):
    (free,) = along_x(ARM, np.array([x]))
    q, flange = np.array(ARM.with_held(free)), ARM.kinematics(free)
    rod = SIZES.rod_length * np.array([np.sin(phi), 0.0, np.cos(phi)])
    column, row = pixel(flange.position + flange.rotation @ ARM.pivot + rod)
    rows, columns = blue_pixels(renderer.draw(q, phi))
    # The rod ends in half a ball, which stands above the point.
    assert rows.min() == pytest.approx(row - 2.0, abs=2.5)
    assert np.mean(columns[rows < rows.min() + 4]) == pytest.approx(column, abs=2.0)


@pytest.mark.parametrize("pivot", [(-0.13, 0.0, 0.0), (-0.13, 0.0, 0.03), (0.0, 0.13, 0.03)])
def test_the_designed_mechanism_is_drawn_between_flange_and_pivot(pivot):
    arm = ARM.model_copy(update={"pivot": pivot})
    mj = film.mujoco()
    model = build_scene(arm).model
    data = mj.MjData(model)
    data.qpos[:] = [*arm.home, 0.0]
    mj.mj_kinematics(model, data)
    flange = arm.kinematics(arm.home_free)
    outward = flange.rotation @ np.array([*pivot[:2], 0.0]) / 0.13
    place = flange.position + flange.rotation @ pivot
    held = [geom for geom in range(model.ngeom) if model.geom(geom).name.startswith("bracket ")]
    corners = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
    ends = np.concatenate(
        [
            (model.geom_aabb[geom, :3] + corners * model.geom_aabb[geom, 3:])
            @ data.geom_xmat[geom].reshape(3, 3).T
            + data.geom_xpos[geom]
            for geom in held
        ]
    )
    along = (ends - place) @ outward
    # From the far side of its plate to the collar on the spindle's end, both sides of the flange.
    assert along.min() == pytest.approx(-0.13 - 0.038, abs=0.004)
    assert along.max() == pytest.approx(0.016, abs=0.002)
    across = (ends - place) @ np.cross(outward, [0.0, 0.0, 1.0])
    assert across.max() == pytest.approx(-across.min(), abs=1e-6)
    # Its plate lies 30 mm above the pivot.
    assert (ends - place)[:, 2].max() == pytest.approx(0.046, abs=0.002)  # the hub, upright
    assert np.sort(np.unique(np.round((ends - place)[:, 2], 4)))[-2] == pytest.approx(0.030)


def test_a_pivot_of_another_holder_keeps_its_plain_bracket():
    model = build_scene(ARM.model_copy(update={"pivot": (-0.2, 0.0, 0.0)})).model
    names = {model.geom(geom).name for geom in range(model.ngeom)}
    assert {"bracket", "bracket 0"} & names == {"bracket"}


def test_a_missing_opengl_is_one_error_with_its_remedy(monkeypatch, run, tmp_path):
    def fail(*_):
        raise RuntimeError("no display")

    monkeypatch.setattr(film.mujoco(), "Renderer", fail)
    with pytest.raises(OutsideError, match="no display; install EGL"):
        write_film(run, tmp_path / "run.webp")
    assert not list(tmp_path.iterdir())


@pytest.mark.usefixtures("renderer")
def test_a_webp_is_the_part_in_real_time_with_its_numbers(run, tmp_path, monkeypatch):
    monkeypatch.setitem(film.FORMATS, film.WEBP, (96, 96, 12.5))
    path = tmp_path / "part.webp"
    write_film(run, path, -4.0, -3.6)
    with Image.open(path) as moving:
        assert (moving.format, moving.size, moving.n_frames) == ("WEBP", (96, 96), 5)
        moving.seek(1)
        picture = np.asarray(moving.convert("RGB"))
        assert moving.info["duration"] == 80
    assert picture[90:].min() < 160  # numbers
    pose = Motion.of(run).at(-3.92)
    expected = RigRenderer(ARM, 96, 87).draw(pose.q, pose.phi, pose.u)
    assert np.mean(np.abs(picture[:87].astype(int) - expected)) < 6.0


@pytest.mark.usefixtures("renderer")
@pytest.mark.full
def test_an_mp4_has_the_frames_of_its_part_and_a_failed_one_leaves_no_file(
    run, tmp_path, monkeypatch
):
    ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="the extra `video` is not installed")
    monkeypatch.setitem(film.FORMATS, film.MP4, (240, 176, 10.0))
    write_film(run, tmp_path / "run.mp4", 0.0, 1.0)
    frames, seconds = ffmpeg.count_frames_and_secs(tmp_path / "run.mp4")
    assert (frames, seconds) == (10, pytest.approx(1.0, abs=0.01))
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", "/bin/false")
    with pytest.raises(OutsideError, match="encoder failed"):
        write_film(run, tmp_path / "other.mp4", 0.0, 0.2)
    assert [path.name for path in tmp_path.iterdir()] == ["run.mp4"]


def test_a_film_that_cannot_be_made_is_refused_before_it_is_drawn(run, monkeypatch):
    long = changed_table(run, "tick", time=np.linspace(1.0, 60.0, 901))
    for log, suffix, begin, end in (
        (run, ".gif", None, None),
        (run, ".webp", -9.0, None),
        (run, ".mp4", 1.0, 0.5),
        (long, ".webp", -20.0, None),
    ):
        with pytest.raises(InputError):
            write_film(log, Path(f"film{suffix}"), begin, end)
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(MissingExtraError):
        write_film(run, Path("film.mp4"))
