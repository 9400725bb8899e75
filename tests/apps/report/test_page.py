"""The page: every part of the story, nothing fetched, nothing let through unescaped."""

import re
import sys
from base64 import b64encode
from dataclasses import replace
from functools import partial
from html.parser import HTMLParser

import pytest

from equipoise import paper
from equipoise.apps.report.choices import chapters, departures
from equipoise.apps.report.markup import Missing
from equipoise.apps.report.page import DRAWINGS, PAGE, build, drawings, page
from equipoise.apps.report.page import FILM as FILM_FILE
from equipoise.apps.report.pictures import Animation, animation, strip
from equipoise.control.control_step import horizon
from equipoise.errors import ArtefactError, OutsideError
from equipoise.identification.recording import write_swing
from equipoise.model.worlds import MODEL, TwinSettings
from equipoise.reproduction import results as files
from equipoise.settings import RECIPES, Settings, resolve
from tests.apps.report import made_up

HOSTILE = "<script>alert('x')</script>&.csv"
SVG = '<svg xmlns="http://www.w3.org/2000/svg"/>'
FILM = Animation(b"moving", b"still")
PICTURES = dict.fromkeys(drawings(made_up.results()), SVG)
EMPTY = {"meta", "img", "source", "br", "path", "rect", "circle", "link", "input"}
SECTIONS = (
    "Verdict",
    "Task and method",
    "Comparison with the paper",
    "Identification from a free swing",
    "Training",
    "The learned policy",
    "Survival on the training plant",
    "Recorded run",
    "Assumptions beyond the paper",
    "Provenance and reproduction",
)


class Reader(HTMLParser):
    """Collects what a browser would, and checks that what is opened is closed."""

    def __init__(self, text):
        super().__init__()
        self.open, self.tags, self.attributes, self.words = [], [], [], []
        self.feed(text.replace("<wbr>", ""))
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += [(tag, name, value or "") for name, value in attrs]
        if tag not in EMPTY:
            self.open.append(tag)

    def handle_endtag(self, tag):
        if tag not in EMPTY:
            assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] not in ("style", "title"):
            self.words.append(data)

    @property
    def text(self):
        return " ".join(" ".join(self.words).replace("\N{NO-BREAK SPACE}", " ").split())


def made(pictures=PICTURES, film=FILM, **changes):
    return page(made_up.results(**changes), pictures, film, made_up.PROVENANCE)


@pytest.fixture(scope="module")
def plain():
    return made()


def test_the_story_is_told_in_its_order(plain):
    assert tuple(re.findall("<h2>(.*)</h2>", plain)) == SECTIONS
    attributes = Reader(plain).attributes
    links = [v for _, name, v in attributes if name == "href"]
    anchors = [v for tag, name, v in attributes if (tag, name) == ("section", "id")]
    assert links[: len(anchors)] == [f"#{anchor}" for anchor in anchors]
    # The others open a figure and close it again.
    places = [v for _, name, v in attributes if name == "id"]
    assert len(set(places)) == len(places)
    assert sorted(links) == sorted(f"#{place}" for place in places)


def test_nothing_is_fetched_and_no_script_runs(plain):
    reader = Reader(plain)
    assert not {"script", "link", "iframe", "object", "embed", "base", "form"} & set(reader.tags)
    for _, name, value in reader.attributes:
        assert not name.startswith("on")
        if name in ("src", "href", "srcset", "action"):
            assert value.startswith(("data:image/", "#"))
    assert "http" not in plain.lower()
    assert "url(" not in plain
    assert "@import" not in plain


def test_every_figure_is_there_once_with_words_for_those_who_cannot_see_it(plain):
    for changes in ({}, {"world": MODEL}, {"recipe": "paper"}):
        reader = Reader(made(**changes) if changes else plain)
        expected = len(drawings(made_up.results(**changes)))
        assert reader.tags.count("img") == expected + 1
        alt = [value for tag, name, value in reader.attributes if (tag, name) == ("img", "alt")]
        assert len(alt) == expected + 1  # the film
        assert all(len(words) > 20 for words in alt)
    assert len(PICTURES) == len(DRAWINGS) + 1  # the encoder's zero


def test_the_film_plays_in_the_page_but_not_for_those_who_asked_for_less_motion(plain):
    moving, still = (f"data:image/webp;base64,{b64encode(part).decode()}" for part in FILM)
    attributes = Reader(plain).attributes
    assert ("img", "src", moving) in attributes
    wanted = attributes.index(("source", "media", "(prefers-reduced-motion: reduce)"))
    assert attributes[wanted + 1] == ("source", "srcset", still)


def test_a_figure_that_could_not_be_drawn_says_why_in_its_place():
    why = Missing("cannot draw <pictures>; install EGL")
    reader = Reader(made(PICTURES | {"figure-3-frames": why}, why))
    assert reader.tags.count("img") == len(PICTURES) - 1
    assert "Missing figure: animation of the arm" in reader.text
    assert "Missing figure: frames of the run" in reader.text
    assert "Reason: cannot draw <pictures>; install EGL." in reader.text


def test_what_comes_from_outside_is_escaped():
    text = made(given=HOSTILE, warnings=["<b>bold</b> & `<i>`"])
    assert "<script" not in text
    assert "<b>bold" not in text
    assert "<i>" not in text
    words = Reader(text).text
    assert HOSTILE in words
    assert "<b>bold</b> &" in words


def test_the_verdict_says_that_it_is_simulation(plain):
    verdict = plain.split('<ol class="verdict">')[1].split("</ol>")[0]
    assert verdict.count("<li>") == 5
    words = Reader(plain).text
    first = plain.split('class="tile"><b>')[1]
    assert first.startswith("20 of 20</b><span>trials stood 60 s on the digital twin twin:nominal;")
    assert "18 of 20" in words
    # Clopper-Pearson for 18 of 20, from any table: 68.3 to 98.8 %.
    assert "68.3 % to 98.8 %" in words
    assert "5 s balancing time of the paper's one run on the real arm" in words
    assert "none is from a robot" in words


def test_the_twin_is_described_with_what_it_has_and_has_not(plain):
    words = Reader(plain).text
    for claim in (
        "replaces the robot, twin:nominal",
        "a setpoint takes effect 10 ms after it was sent",
        "servo law of the KUKA Sunrise Toolbox's server",
        "drives with a lag of 8 ms",
        "not the load of tool and pendulum (250 g)",
        "dry friction of 0.1 1/s²",
        "An encoder with 8,192 counts per turn, read 1 ms late, whose zero is wrong by up to 0.2°",
        "The twin does not model: elasticity, friction and backlash",
        "not published",
        "not the authors' robot",
        "error of the encoder's zero unknown −0.11°",
        "Mass of the pendulum, unknown to the drive",  # from the docstrings of its numbers
        "World of the recorded run: twin:nominal",
    ):
        assert claim in words, claim


@pytest.mark.parametrize("lead", [False, True])
def test_what_the_policy_saw_is_ahead_by_the_horizon_of_the_controller(lead):
    found = made_up.results()
    conditions, policy = found.run.conditions, found.policy
    controller = conditions.settings.controller.model_copy(update={"lead": lead})
    settings = conditions.settings.model_copy(update={"controller": controller})
    run = replace(found.run, conditions=conditions.model_copy(update={"settings": settings}))
    text = Reader(page(found._replace(run=run), PICTURES, FILM, made_up.PROVENANCE)).text
    ahead = horizon(policy.arm, policy.actuator, controller.margin, lead=lead)
    assert f"the state {1e3 * ahead:.0f} ms ahead" in text


def test_an_arm_without_a_twin_runs_on_the_model_and_the_page_says_so():
    words = Reader(made(world=MODEL)).text
    assert "There is no twin of the iiwa7" in words
    for claim in ("a setpoint takes effect", "the drives do not", "ms ahead"):
        assert claim not in words


def test_a_policy_of_the_paper_has_no_cures_and_the_page_says_so():
    words = Reader(made(recipe="paper")).text
    assert "The arm follows its commands at once" in words
    assert "estimates angle, angular" not in words


def test_angles_are_written_alike_everywhere(plain):
    shown = Reader(re.sub("<code>.*?</code>", "", plain)).text
    assert not re.findall(r"\b(?:deg|phi|theta)\b|\d degrees?\b", shown)
    assert "|φ| up to 2.9 of 11°" in shown


def test_a_table_that_is_wide_names_its_columns_in_its_cells(plain):
    assert '<td data-label="95 % interval">' in plain
    assert 'data-label="time [s]"' not in plain  # two columns fit everywhere


def test_departures_are_those_of_the_settings(plain):
    robust, paper_ = (" ".join(departures(resolve(name))) for name in ("robust", "paper"))
    assert robust in Reader(plain).text
    for departure in ("nonlinear", "mirror", "held", "learning rate", "sensor", "prediction"):
        assert departure in robust
        assert departure not in paper_
    assert "limit is a failure" in paper_
    without = resolve(overrides=["controller.predict=false", "selection.every=0"])
    shorter = " ".join(departures(without))
    assert "prediction" not in shorter
    assert "last table" not in shorter


def test_a_quick_look_says_so():
    assert "Quick run, with fewer episodes and trials." in Reader(made(quick=True)).text
    assert "Quick run" not in Reader(made()).text


def test_the_paper_is_quoted_with_its_own_numbers(plain):
    words = Reader(plain).text
    for number in (
        f"around {paper.FREE_SWING_PERIOD:g} s",
        "270 boxes × 8 accelerations",
        f"{paper.EPISODES:,}",
        "x passed −0.22 m, at φ = −3.44°",
        "“few minutes”",
    ):
        assert number in words


def test_a_run_that_failed_is_told_as_one():
    words = Reader(made(lasted=20.0, cause="track")).text
    assert "left the track after 20 s of 60 s" in words
    assert "stood all" not in words


def test_a_recording_that_was_given_is_named_and_has_no_truth_beside_it():
    words = Reader(made(given="mine.csv")).text
    assert "mine.csv" in words
    assert "equipoise reproduce --swing mine.csv" in words
    assert "one is simulated" not in words


def test_warnings_of_the_identification_are_shown():
    assert (
        "viscous friction does not explain"
        in Reader(made(warnings=["viscous friction does not explain the recording"])).text
    )


def test_a_policy_that_nobody_selected_is_told_as_one():
    assert "no selection took place" in Reader(made(recipe="paper")).text


def test_every_setting_is_there_with_value_and_reason(plain):
    words = Reader(plain).text
    for section, model in Settings.model_fields.items():
        for key in model.annotation.model_fields:
            assert f"{section}.{key}" in words
    assert "learning.episodes 10,000" in words
    assert "controller.margin 0.005 s" in words
    for key in TwinSettings.model_fields:
        assert f" {key} " in words


@pytest.mark.parametrize(("recipe", "other"), [("robust", "paper"), ("paper", "robust")])
def test_the_other_recipe_stands_beside_the_one_that_was_used(recipe, other):
    table = made(recipe=recipe)
    assert f"recipe <code>{other}</code>" in table
    assert f"recipe <code>{recipe}</code></th>" not in table


def test_choices_take_unit_and_reason_from_the_docstring():
    settings = resolve()
    other = resolve("paper")
    choices = {c.name: c for chapter in chapters(settings, other) for c in chapter.choices}
    assert len(choices) == sum(
        len(model.annotation.model_fields) for model in Settings.model_fields.values()
    )
    K_p = choices["clik.K_p"]
    assert K_p.value == "400 1/s^2"
    assert K_p.reason.startswith("Gain on the pose error. With K_d")
    assert "[" not in K_p.reason
    assert choices["evaluation.phi_high"].value == "0.04363 rad (2.5°)"
    assert choices["learning.mirrored"].value == "yes"
    shown = {name for name, c in choices.items() if c.otherwise}
    assert shown <= set(RECIPES["paper"])
    assert "learning.start_x" in shown
    assert choices["learning.mirrored"].otherwise == "no"
    assert all(c.reason for c in choices.values())


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder as `reproduce` leaves it."""
    out = tmp_path_factory.mktemp("machine") / "report"
    found = made_up.results()
    write_swing(out / files.SWING, found.swing)
    # The digest of a recording is that of its file.
    swing = files.read_swing(out / files.SWING)
    identified = made_up.pendulum(swing)
    policy = made_up.policy(identified)
    found = found._replace(
        swing=swing,
        pendulum=identified,
        policy=policy,
        evaluation=made_up.evaluation(policy),
        run=made_up.run(policy, lasted=8.0, cause="track", world="twin:nominal"),
        twin_evaluation=made_up.twin_evaluation(policy),
    )
    record = found.record.model_copy(update={"files": files.digests(found)})
    for value, name in (
        (found.pendulum, files.PENDULUM),
        (found.policy, files.POLICY),
        (found.evaluation, files.EVALUATION),
        (found.run, files.RUN),
        (found.twin_evaluation, files.TWIN_EVALUATION),
        (record, files.RECORD),
    ):
        value.save(out / name, command="test")
    return out


def sketched(figure, stem):
    files = [stem.with_name(f"{stem.name}.{ending}") for ending in ("svg", "png")]
    for file in files:
        file.parent.mkdir(exist_ok=True)
        file.write_text(SVG)
    return files


def test_the_page_is_built_from_the_folder_alone(folder, monkeypatch):
    # Every figure has its own tests; here they are drawn, but not rendered.
    monkeypatch.setattr("equipoise.apps.report.page.save", sketched)
    monkeypatch.setattr(sys.modules[strip.__module__], "FRAME", (64, 64))
    small = partial(animation, size=(96, 96), end=0.3)
    monkeypatch.setattr("equipoise.apps.report.page.animation", small)
    told = []
    path = build(folder, lambda name, share: told.append((name, share)))
    assert path == folder / PAGE
    text = path.read_text(encoding="utf-8")
    Reader(text)
    assert folder.parent.name not in text  # no path of this machine
    assert sorted(p.name for p in (folder / "figures").iterdir()) == sorted(
        [FILM_FILE, *(f"{name}.{ending}" for name in PICTURES for ending in ("png", "svg"))]
    )
    shares = [share for _, share in told]
    assert shares == sorted(shares)
    assert told[-1] == (PAGE, 1.0)


def test_a_machine_without_opengl_gets_the_rest(folder, tmp_path, monkeypatch):
    def fails(run, arm, report=None):
        raise OutsideError("cannot draw pictures; install EGL")

    monkeypatch.setattr("equipoise.apps.report.page.strip", fails)
    monkeypatch.setattr("equipoise.apps.report.page.animation", fails)
    monkeypatch.setattr("equipoise.apps.report.page.save", sketched)
    copied(folder, tmp_path)
    text = build(tmp_path).read_text(encoding="utf-8")
    assert "Reason: cannot draw pictures; install EGL." in Reader(text).text
    assert not list((tmp_path / "figures").glob("figure-3*"))
    assert len(list((tmp_path / "figures").iterdir())) == 2 * (len(PICTURES) - 1)


def copied(folder, to):
    for path in folder.iterdir():
        if path.is_file():
            (to / path.name).write_bytes(path.read_bytes())


def test_a_file_of_another_reproduction_is_refused(folder, tmp_path):
    copied(folder, tmp_path)
    other = made_up.evaluation(files.TabularPolicy.load(folder / files.POLICY), falls=(1.0,))
    other.save(tmp_path / files.EVALUATION, command="test")
    with pytest.raises(ArtefactError, match=r"evaluation\.json is not the file"):
        build(tmp_path)
    (tmp_path / files.RUN).unlink()
    with pytest.raises(ArtefactError, match=r"there is no file .*run\.mcap"):
        build(tmp_path)
