"""The page: every section, nothing fetched, nothing let through unescaped."""

import re
from html.parser import HTMLParser

import pytest

from equipoise import film, paper
from equipoise.apps.report import page as page_module
from equipoise.apps.report.page import FIGURES, PAGE, build, page
from equipoise.errors import ArtefactError, OutsideError
from equipoise.identification.recording import write_swing
from equipoise.model.worlds import MODEL, TwinSettings
from equipoise.outcomes import Outcome
from equipoise.reproduction import results as files
from equipoise.settings import Settings
from tests.apps.report import made_up

HOSTILE = "<script>alert('x')</script>&\x1b[2J.csv"
IMAGES = dict.fromkeys([*FIGURES, "film"], "data:image/svg+xml;base64,AA==")
EMPTY = {"meta", "img", "br", "path", "rect", "circle", "wbr"}


class Reader(HTMLParser):
    """Collects what a browser would, and checks that what is opened is closed."""

    def __init__(self, text):
        super().__init__()
        self.open, self.tags, self.attributes, self.words = [], [], [], []
        self.feed(text)
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
        return " ".join("".join(self.words).split())


def made(missing="", **changes):
    return page(made_up.results(**changes), IMAGES, made_up.PROVENANCE, missing)


@pytest.fixture(scope="module")
def plain():
    return made()


def test_all_links_lead_to_a_place_and_all_sections_are_linked(plain):
    attributes = Reader(plain).attributes
    links = [v for _, name, v in attributes if name == "href"]
    places = [v for _, name, v in attributes if name == "id"]
    sections = [v for tag, name, v in attributes if (tag, name) == ("section", "id")]
    to_sections = [link for link in links if not link.startswith(("#at-", "#large-"))]
    assert to_sections == [f"#{section}" for section in sections]
    assert len(set(places)) == len(places)
    assert {link[1:] for link in links} == set(places)


@pytest.mark.parametrize("changes", [{}, {"world": MODEL}, {"recipe": "paper"}])
def test_every_figure_is_there_nothing_is_fetched_and_no_script_runs(changes):
    text = made(**changes)
    reader = Reader(text)
    assert reader.tags.count("img") == len(IMAGES)
    assert all(len(v) > 20 for tag, name, v in reader.attributes if (tag, name) == ("img", "alt"))
    assert not {"script", "link", "iframe", "object", "embed", "base", "form"} & set(reader.tags)
    for _, name, value in reader.attributes:
        assert not name.startswith("on")
        if name in ("src", "href", "srcset", "action"):
            assert value.startswith(("data:image/", "#"))
    assert not re.search(r"http|url\(|@import", text)


def test_texts_from_outside_are_escaped():
    text = made(missing=HOSTILE, given=HOSTILE, warnings=["<b>bold</b> & `<i>`"])
    assert not re.search("<script|<b>bold|<i>|\x1b", text)
    words = Reader(text).text
    assert "<script>alert('x')</script>&\\x1b[2J.csv" in words
    assert "<b>bold</b> & <i>" in words


def test_the_numbers_are_those_of_the_results_and_of_the_paper(plain):
    words = Reader(plain).text
    for number in (
        "18 of 20",
        "5.5 s",
        "68.3 % to 98.8 %",  # Clopper-Pearson for 18 of 20, from any table
        f"around {paper.FREE_SWING_PERIOD:g} s",
        "270 boxes × 8 accelerations",
        f"{paper.EPISODES:,}",
        "x passed -0.22 m",
    ):
        assert number in words, number


@pytest.mark.parametrize(
    ("changes", "there"),
    [
        ({"quick": True}, "Quick run"),
        ({"missing": "no OpenGL"}, "no OpenGL"),
        ({"lasted": 20.0, "cause": Outcome.TRACK}, "left the track after 20 s"),
        ({"warnings": ["friction is odd"]}, "friction is odd"),
    ],
)
def test_the_page_depends_on_the_results(plain, changes, there):
    assert there in Reader(made(**changes)).text
    assert there not in Reader(plain).text


def test_every_setting_is_there_with_value_and_reason(plain):
    words = Reader(plain).text
    for section, model in Settings.model_fields.items():
        for key in model.annotation.model_fields:
            assert f"{section}.{key}" in words
    assert "clik.K_p400Gain on the pose error" in words
    for key in TwinSettings.model_fields:
        assert key in words


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder as `reproduce` leaves it."""
    out = tmp_path_factory.mktemp("machine") / "report"
    found = made_up.results()
    write_swing(out / files.SWING, found.swing)
    # The digest of a recording is that of its file.
    swing = files.read_swing(out / files.SWING)
    policy = made_up.policy(made_up.pendulum(swing))
    found = found._replace(
        swing=swing,
        pendulum=policy.pendulum,
        policy=policy,
        evaluation=made_up.evaluation(policy),
        twin_evaluation=made_up.twin_evaluation(policy),
        without_prediction=made_up.twin_evaluation(policy, 20 * (5.5,)),
        run=made_up.run(policy, lasted=8.0, cause=Outcome.TRACK, world="twin:nominal"),
    )
    record = found.record.model_copy(update={"files": dict(files.digests(found))})
    for value, name in (
        (found.pendulum, files.PENDULUM),
        (found.policy, files.POLICY),
        (found.evaluation, files.EVALUATION),
        (found.twin_evaluation, files.TWIN_EVALUATION),
        (found.without_prediction, files.WITHOUT_PREDICTION),
        (found.run, files.RUN),
        (record, files.RECORD),
    ):
        value.save(out / name, command="test")
    return out


@pytest.mark.full
def test_the_page_is_built_from_the_folder_alone(folder, monkeypatch):
    monkeypatch.setitem(film.FORMATS, film.WEBP, (64, 64, 2.0))
    told = []
    path = build(folder, lambda name, share: told.append((name, share)))
    text = path.read_text(encoding="utf-8")
    Reader(text)
    assert path == folder / PAGE
    assert folder.parent.name not in text  # no path of this machine
    assert {f"{name}.svg" for name in FIGURES} < {p.name for p in (folder / "figures").iterdir()}
    assert told[-1] == (PAGE, 1.0)


@pytest.mark.full
def test_without_opengl_the_page_says_why_the_film_is_missing(folder, monkeypatch):
    def fail(*_, **__):
        raise OutsideError("cannot draw pictures")

    monkeypatch.setattr(page_module, "write_film", fail)
    monkeypatch.setattr(page_module, "FIGURES", dict.fromkeys(FIGURES, FIGURES["swing"]))
    text = build(folder).read_text(encoding="utf-8")
    assert "The film of the run is missing: cannot draw pictures." in Reader(text).text


def test_a_file_of_another_reproduction_is_refused(folder, tmp_path):
    for path in folder.iterdir():
        if path.is_file():
            (tmp_path / path.name).write_bytes(path.read_bytes())
    other = made_up.evaluation(files.TabularPolicy.load(folder / files.POLICY), falls=(1.0,))
    other.save(tmp_path / files.EVALUATION, command="test")
    with pytest.raises(ArtefactError):
        build(tmp_path)
