"""The page: every section, nothing fetched, nothing let through unescaped."""

import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from equipoise import Settings, film, shipped_actuator
from equipoise.errors import OutsideError
from equipoise.model.worlds import MODEL, TwinSettings
from equipoise.outcomes import Outcome
from equipoise.report import page as page_module
from equipoise.report.page import FIGURES, PAGE, build, page
from tests.report import made_up

ROOT = Path(__file__).parents[2]
HOSTILE = "<script>alert('x')</script>&\x1b[2J.csv"
IMAGES = dict.fromkeys([*FIGURES, "film"], "data:image/svg+xml;base64,AA==")
DELAY = f"{round(1e3 * shipped_actuator().delay.value, 1):g}"
ENDS = (1.49 - made_up.AHEAD, 59.99 - made_up.AHEAD)
EMPTY = {"meta", "img", "br", "path", "rect", "circle"}


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
    links = [link for link in links if link.startswith("#")]
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
        if name in ("src", "srcset", "action"):
            assert value.startswith("data:image/")
    assert not re.search(r"url\(|@import", text)


def test_links_lead_within_the_page_or_to_pages_of_the_repository():
    addresses = [value for _, name, value in Reader(made()).attributes if name == "href"]
    outside = [address for address in addresses if not address.startswith("#")]
    assert len(outside) == 3
    for address in outside:
        assert (ROOT / address.partition("/blob/main/")[2]).is_file()


def test_texts_from_outside_are_escaped():
    text = made(missing=HOSTILE, given=HOSTILE, warnings=["<b>bold</b> & `<i>`"])
    assert not re.search("<script|<b>bold|<i>|\x1b", text)
    words = Reader(text).text
    assert "<script>alert('x')</script>&\\x1b[2J.csv" in words
    assert "<b>bold</b> & <i>" in words


def test_the_comparison_states_the_paper_and_both_recipes(plain):
    head, *lines = re.findall("<tr>(.*?)</tr>", plain.partition("</table>")[0])
    cells = re.compile("<t[hd].*?</t[hd]>")
    table = [[Reader(cell).text for cell in cells.findall(line)] for line in lines]
    assert head.count("<th>") == 4
    # Clopper-Pearson of 18 of 20, 10 of 20 and 20 of 20, from any table.
    assert table == [
        ["delay in training [ms]", "not stated", "0", DELAY],
        ["simulation trials", "not stated", "20", "20"],
        ["simulation median [s]", "not stated", "45", "60"],
        ["simulation survived 60s", "not stated", "10", "18"],
        ["simulation interval (95 %)", "not stated", "0.272 to 0.728", "0.683 to 0.9877"],
        ["simulation ended by", "not stated", "track 10, survived 10", "track 2, survived 18"],
        ["robot or twin trials", "1", "20", "20"],
        ["robot or twin median [s]", "5", "5.5", "60"],
        ["robot or twin survived 5s", "1", "20", "20"],
        ["robot or twin interval (95 %)", "not stated", "0.8316 to 1", "0.8316 to 1"],
        ["robot or twin ended by", "track 1", "track 20", "survived 20"],
        ["run [s]", "5", "1.5", "60"],
        ["run ended by", "track", "angle", "survived"],
        # The made-up true state at the last tick is that of `AHEAD` before.
        [
            "lean at its end [deg]",
            "-3.44",
            *(f"{round(np.degrees(0.05 * np.sin(8 * t)), 2):g}" for t in ENDS),
        ],
        ["x at its end [m]", "-0.22", *(f"{round(0.12 * np.sin(t), 3):g}" for t in ENDS)],
    ]


@pytest.mark.parametrize(
    ("changes", "there"),
    [
        ({"missing": "no OpenGL"}, "no OpenGL"),
        ({"survival": 20.0, "cause": Outcome.TRACK}, "survived 20 s of 60 s"),
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


@pytest.mark.full
def test_the_page_is_built_with_its_figures_and_its_film(tmp_path, monkeypatch):
    monkeypatch.setitem(film.FORMATS, film.WEBP, (64, 64, 2.0))
    path = build(made_up.results(survival=8.0, cause=Outcome.TRACK), tmp_path / "report")
    text = path.read_text(encoding="utf-8")
    Reader(text)
    assert path == tmp_path / "report" / PAGE
    assert tmp_path.name not in text  # no path of this machine
    drawn = {p.name for p in (path.parent / "figures").iterdir()}
    assert {f"{name}.svg" for name in FIGURES} < drawn


@pytest.mark.full
def test_without_opengl_the_page_says_why_the_film_is_missing(tmp_path, monkeypatch):
    def fail(*_, **__):
        raise OutsideError("cannot draw pictures")

    monkeypatch.setattr(page_module, "write_film", fail)
    monkeypatch.setattr(page_module, "FIGURES", dict.fromkeys(FIGURES, FIGURES["swing"]))
    text = build(made_up.results(), tmp_path).read_text(encoding="utf-8")
    assert "The film of the run is missing: cannot draw pictures." in Reader(text).text
