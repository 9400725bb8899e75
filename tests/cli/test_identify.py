"""`equipoise identify`: what it writes and prints, and what it refuses."""

import json
import os
import sys

import numpy as np
import pytest

from equipoise.model.pendulum import Pendulum
from tests.cli.conftest import COSINE, TIME

TRUTH = 70.2


def test_it_writes_the_pendulum_and_figure_2_beside_it(equipoise, swing, tmp_path):
    ran = equipoise("identify", swing)
    assert ran.code == 0
    found = Pendulum.load(tmp_path / "pendulum.json")
    assert found.w2.low < TRUTH < found.w2.high
    assert (tmp_path / "pendulum.png").read_bytes().startswith(b"\x89PNG")
    assert "<svg" in (tmp_path / "pendulum.svg").read_text()
    assert "w2 = m g l / I" in ran.out
    assert ran.out.endswith("next: equipoise train pendulum.json\n")


def test_a_second_pendulum_is_numbered_with_its_figure(equipoise, swing, tmp_path):
    for name in ("pendulum.json", "pendulum-2.svg"):
        (tmp_path / name).write_text("mine")
    ran = equipoise("identify", swing)
    assert ran.code == 0, ran
    assert "wrote pendulum-3.json, pendulum-3.svg and pendulum-3.png" in ran.out
    assert ran.out.endswith("next: equipoise train pendulum-3.json\n")
    assert (tmp_path / "pendulum.json").read_text() == "mine"
    assert (tmp_path / "pendulum-2.svg").read_text() == "mine"


@pytest.mark.skipif(sys.platform != "linux", reason="such names exist on Linux alone")
def test_a_recording_whose_name_is_not_utf_8_is_identified(equipoise, swing, tmp_path):
    name = swing.rename(tmp_path / os.fsdecode(b"sw\xe9\xffng.csv"))
    out = tmp_path / os.fsdecode(b"p\xff.json")
    ran = equipoise("identify", name, "--no-figure", "--out", out)
    assert ran.code == 0, ran
    assert Pendulum.load(out).fit.source == r"sw\udce9\udcffng.csv"


def test_json_is_one_object_with_the_stable_keys(equipoise, swing):
    ran = equipoise("identify", swing, "--json", "--no-figure")
    assert {"w2", "w2_interval", "c", "c_interval", "rms_deg", "warnings"} <= ran.json.keys()
    low, high = ran.json["w2_interval"]
    assert low < ran.json["w2"] < high
    assert "inertia" not in ran.json
    assert ran.err == ""


def test_mass_and_length_give_inertia_and_friction(equipoise, swing):
    mass, length, g = 0.2, 0.15, 9.80665
    apart = ("--mass", mass, "--mass-uncertainty", 0.002, "--length", length)
    found = equipoise("identify", swing, "--json", "--no-figure", *apart).json
    assert found["inertia"] == pytest.approx(mass * g * length / found["w2"])
    assert found["friction"] == pytest.approx(found["c"] * found["inertia"])
    low, high = found["inertia_interval"]
    # One percent of the mass, 1.96 standard deviations, both ways; the swing itself adds little.
    assert (high - low) / found["inertia"] == pytest.approx(2 * 1.96 * 0.01, rel=0.05)
    low, high = found["friction_interval"]
    assert low < found["friction"] < high


def test_a_window_a_friction_model_and_settings_reach_the_fit(equipoise, swing, tmp_path):
    (tmp_path / "mine.toml").write_text("[identification]\ng = 9.81\n")
    window = ("--start", 1.5, "--end", 6.0, "--friction", "coulomb")
    found = equipoise(
        "identify", swing, *window, "--settings", "mine.toml", "--json", "--no-figure"
    ).json
    assert found["window"] == [1.5, 6.0]
    assert found["friction_model"] == "coulomb"
    assert found["k"] == pytest.approx(found["w2"] / 9.81)


def test_counts_from_upright_are_read(equipoise, csv):
    counts = np.round((np.pi - COSINE) * 4096 / (2.0 * np.pi)).astype(int)
    path = csv("time_s,counts", TIME, counts)
    ran = equipoise(
        "identify", path, "--counts-per-rev", 4096, "--from-upright", "--json", "--no-figure"
    )
    # A cosine of 29 degrees is a pendulum but for its slower period: T grows by A^2 / 16.
    assert ran.json["w2"] == pytest.approx((2 * np.pi / 0.75) ** 2 * (1 + 0.25 / 8), rel=0.01)


def test_a_file_without_a_header_is_read_by_its_columns(equipoise, refused, csv):
    path = csv(f"{0.0},{np.rad2deg(COSINE[0])}", 1e3 * TIME[1:], np.rad2deg(COSINE[1:]))
    refused("identify", path, saying="--columns time_s,theta_deg")
    ran = equipoise("identify", path, "--columns", "time_ms,theta_deg", "--json", "--no-figure")
    assert ran.json["w2"] == pytest.approx((2 * np.pi / 0.75) ** 2 * (1 + 0.25 / 8), rel=0.01)


def test_warnings_are_printed_and_listed(equipoise, csv):
    amplitude = 0.6 - 0.06 * TIME  # dry friction: the amplitude falls by the same in each period
    path = csv("time_s,theta_rad", TIME, amplitude * np.cos(2.0 * np.pi * TIME / 0.75))
    ran = equipoise("identify", path, "--no-figure")
    assert "warning: " in ran.out
    assert "--friction" in ran.out
    assert equipoise("identify", path, "--no-figure", "--json").json["warnings"]


def flawed(values, at, value):
    column = [str(v) for v in values]
    column[at] = value
    return column


RECORDINGS = {
    "shorter than a period": (("time_s,theta_rad", TIME[:100], COSINE[:100]), "less than one"),
    "no oscillation": (
        ("time_s,theta_rad", TIME, np.random.default_rng(0).normal(0.0, 1e-3, TIME.size)),
        "no oscillation above the noise",
    ),
    "at rest": (("time_s,theta_rad", TIME, np.zeros(TIME.size)), "no oscillation"),
    "time stands still": (
        ("time_s,theta_rad", flawed(TIME, 300, TIME[299]), COSINE),
        "line 302: time does not increase",
    ),
    "time runs backwards": (("time_s,theta_rad", TIME[::-1], COSINE), "time does not increase"),
    "NaN": (("time_s,theta_rad", TIME, flawed(COSINE, 300, "nan")), "line 302: theta_rad is 'nan'"),
    "infinite": (("time_s,theta_deg", TIME, flawed(COSINE, 3, "inf")), "line 5: theta_deg"),
    "empty cell": (("time_s,theta_rad", TIME, flawed(COSINE, 300, "")), "expected a finite number"),
    "wrong columns": (
        ("t,angle", TIME, COSINE),
        "has the columns t, angle; expected one of time_s",
    ),
    "two quantities": (("time_s,theta_rad,counts", TIME, COSINE, TIME), "one of theta_rad"),
    "over the top": (("time_s,theta_rad", TIME, 9.0 * TIME), "goes over the top"),
    "counts of unknown size": (("time_s,counts", TIME, COSINE), "--counts-per-rev"),
    "header only": (("time_s,theta_rad", [], []), "holds no samples"),
}


@pytest.mark.parametrize("flaw", RECORDINGS)
def test_a_recording_that_identifies_nothing_is_refused(refused, csv, flaw):
    columns, saying = RECORDINGS[flaw]
    refused("identify", csv(*columns), saying=saying)


def test_what_is_no_recording_is_refused(refused, tmp_path):
    (tmp_path / "empty.csv").write_text("")
    (tmp_path / "picture.csv").write_bytes(b"\x89PNG\xff\xfe\x00")
    refused("identify", "nowhere.csv", saying="there is no file nowhere.csv")
    refused("identify", tmp_path, saying="cannot read")
    refused("identify", "empty.csv", saying="has the columns (none)")
    refused("identify", "picture.csv", saying="is not UTF-8")
    refused("identify", saying="Missing argument")


OPTIONS = {
    "window outside": (("--start", "20"), "choose --start and --end inside"),
    "window turned round": (("--start", "3", "--end", "2"), "choose --start and --end inside"),
    "unknown friction": (("--friction", "magic"), "identification.friction"),
    "counts per revolution of zero": (("--counts-per-rev", "0"), "--counts-per-rev"),
    "mass alone": (("--mass", "0.2"), "both --mass and --length"),
    "mass of zero": (("--mass", "0", "--length", "1"), "--mass is 0"),
    "mass of a ship": (("--mass", "1e7", "--length", "1e7"), "--mass is 10000000.0 kg"),
    "mass that is no number": (("--mass", "nan", "--length", "1"), "--mass is nan"),
    "uncertainty alone": (("--length-uncertainty", "0.1"), "without --length"),
    "uncertainty too large": (
        ("--mass", "1", "--length", "1", "--mass-uncertainty", "2"),
        "--mass-uncertainty is 2",
    ),
    "unknown setting": (("--set", "identification.frictions=1"), "there is no setting"),
    "unknown section": (("--set", "identificaton.g=9.81"), "there is no setting"),
    "no setting": (("--set", "g"), "expected NAME=VALUE"),
    "impossible setting": (("--set", "identification.g=-1"), "setting identification.g"),
    "missing settings": (("--settings", "no.toml"), "there is no file no.toml"),
    "unknown option": (("--frictoin", "coulomb"), "No such option"),
}


@pytest.mark.parametrize("flaw", OPTIONS)
def test_options_that_cannot_be_meant_are_refused(refused, swing, flaw):
    options, saying = OPTIONS[flaw]
    refused("identify", swing, *options, saying=saying)


def test_settings_that_are_no_toml_are_refused(refused, swing, tmp_path):
    (tmp_path / "bad.toml").write_text("identification = [")
    refused("identify", swing, "--settings", "bad.toml", saying="not valid TOML")


def test_an_output_that_cannot_be_is_refused_before_the_work(refused, swing, tmp_path):
    (tmp_path / "folder.json").mkdir()
    (tmp_path / "file").write_text("")
    refused("identify", swing, "--out", "folder.json", saying="is a folder")
    refused("identify", swing, "--out", "file/pendulum.json", saying="file is a file")
    refused("identify", swing, "--out", "file/deep/pendulum.json", saying="cannot write in")
    refused("identify", swing, "--out", swing, saying="ends in .json")


def test_an_error_with_json_leaves_stdout_empty(refused):
    assert refused("identify", "nowhere.csv", "--json", saying="nowhere.csv").out == ""


def test_the_example_of_the_docs_is_json(equipoise, swing):
    text = equipoise("identify", swing, "--json", "--no-figure").out
    assert text.count("\n") == 1
    assert isinstance(json.loads(text), dict)


def test_the_amplitudes_of_the_numbers_and_a_release_that_was_found_are_printed(
    equipoise, csv, swing
):
    ran = equipoise("identify", swing, "--no-figure")
    assert "deg at first" in ran.out
    held = np.concatenate((np.full(250, COSINE[0]), COSINE))
    path = csv("time_s,theta_rad", np.arange(held.size) * (TIME[1] - TIME[0]), held)
    assert "(release)" in equipoise("identify", path, "--no-figure").out
    started = equipoise("identify", path, "--no-figure", "--start", 250 * (TIME[1] - TIME[0]))
    assert "the hand lets go" not in started.out


@pytest.mark.parametrize("scale", [1e3, 1e-300])
def test_milliseconds_taken_for_seconds_are_asked_about_and_nothing_is_trained(refused, csv, scale):
    path = csv("time_s,theta_rad", scale * TIME, COSINE)
    assert "next:" not in refused("identify", path, saying="is the time in seconds?").out
