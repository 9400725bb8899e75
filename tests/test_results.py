"""What the pages print of the file of results is what the file says, and nothing is unmarked."""

import importlib.util
import json
import re
from pathlib import Path

import pytest
from markdown_it import MarkdownIt

from tests.cli.conftest import parse
from tests.test_pages import OTHERS, commands

ROOT = Path(__file__).parents[1]
spec = importlib.util.spec_from_file_location("results", ROOT / "docs" / "results.py")
results = importlib.util.module_from_spec(spec)
spec.loader.exec_module(results)

FILE = json.loads(results.FILE.read_text())
PAGES = {path.relative_to(ROOT).as_posix(): path.read_text() for path in results.PAGES}
MARKED = [page for page, text in PAGES.items() if "<!--" in text]


@pytest.mark.parametrize("page", PAGES)
def test_a_page_prints_what_the_file_says(page):
    assert results.differences(PAGES[page], FILE) == []
    assert results.render(PAGES[page], FILE) == PAGES[page]


@pytest.mark.parametrize("page", MARKED)
def test_every_digit_that_is_edited_by_hand_is_found_and_named(page):
    text, edited = PAGES[page], 0
    for mark, (begin, end), _ in results.texts(text, FILE):
        for digit in re.finditer(r"\d", text[begin:end]):
            place = begin + digit.start()
            wrong = text[:place] + str((int(digit[0]) + 1) % 10) + text[place + 1 :]
            (named,) = results.differences(wrong, FILE)
            assert named.startswith(mark)
            assert results.render(wrong, FILE) == text
            edited += 1
    assert edited


@pytest.mark.parametrize("page", PAGES)
def test_no_line_begins_with_a_percent_sign_which_the_site_leaves_out(page):
    assert not re.search(r"^\s*%", PAGES[page], re.MULTILINE)


@pytest.mark.parametrize("page", MARKED)
def test_a_viewer_of_markdown_shows_no_trace_of_the_marks(page):
    shown = MarkdownIt("commonmark").enable("table").render
    mark = re.compile(r"<!--table=.*\n|<!--.*?-->")
    assert mark.sub("", shown(PAGES[page])) == shown(mark.sub("", PAGES[page]))


@pytest.mark.parametrize(
    ("page", "message"),
    [
        ("of <!--=map.slices.0.rat-->76<!--/-->", "no such value"),
        ("of <!--=map.slices.7.rate-->76<!--/-->", "no such value"),
        ("of <!--=map.slices.0.rate-->76", "damaged"),
        ("of 76<!--/-->", "damaged"),
        ("of <!--=map.slices.0.rate --> 76 %<!--/-->", "damaged"),
        ("<!--table=compare.rows|{name}-->\n\n| a |\n| - |\n", "damaged"),
        ("lasts\n<!--=map.slices.0.rate-->76<!--/--> s", "starts a line"),
        ("- <!--=map.slices.0.rate-->76<!--/--> s", "starts a line"),
    ],
)
def test_a_mark_that_would_print_nothing_is_refused(page, message):
    with pytest.raises(ValueError, match=message):
        results.render(page, FILE)


@pytest.mark.skipif(not (results.ROOT / ".git").exists(), reason="the tree is no clone")
def test_a_run_stores_what_the_command_writes_with_its_commit(tmp_path, monkeypatch):
    monkeypatch.setattr(results, "FILE", tmp_path / "results.json")
    command = """echo '{"rate": 0.123456789, "n": 7, "at": "'$COMMIT'"}' > $JSON"""
    section = results.run(command, "")
    assert section["command"] == command
    assert section["values"] == {"rate": 0.123457, "n": 7, "at": section["commit"]}
    results.write({"a": section})
    assert json.loads(results.FILE.read_text()) == {"a": section}


@pytest.mark.parametrize("section", FILE)
def test_the_command_of_a_section_exists(section):
    for name, *words in commands(FILE[section]["command"].replace("> $JSON", "")):
        if name == "equipoise":
            parse(words)
        elif name == "python":
            assert (ROOT / words[0]).is_file()
        else:
            assert name in OTHERS


# Results without a mark

RESULT = re.compile(
    r"\d of [\d,]+ (?!to)"
    r"|\b(?:surviv(?:e|es|ed)|balanced|holds?|held)\s(?:\w+\s){0,3}?\d"
    r"|\d ?%|\[\d[\d.]*, \d|\d s on `|\d mm (?:rms|\()"
)
"""What looks like a result: a fraction, a survival, an interval, a distance from the middle."""
NOT_RESULTS = (
    results.TABLE,
    results.MARK,
    re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL),
    re.compile(r"60 s\b|95\s%\sintervals?(?!\s\d)"),  # length of a trial, and a name
)
SENTENCE = re.compile(r"(?<=[.:;!?])\s+|\n")
WRAP = re.compile(r"\n(?![\n|#>*-]|\d+\. )")
"""A line break within a paragraph."""
SEARCHED = re.compile(r"(README|CHANGELOG|docs/\w+|docs/(explanation|how-to)/.*|course/.*)\.md")
THEORY = {"docs/safety-case.md", "docs/explanation/claims.md", "docs/how-to/real-time.md"}
"""Pages whose shares follow from a formula, or are requirements."""
ALLOWED = (
    "until one meets 99 %",
    "the randomization of the training (2 % of the inertia",
    "survived 5 s on their arm",
    "that survive 95 % of their trials in simulation",
)
"""Defaults, formulas, settings, and the paper's own result."""


def unmarked(text):
    """The sentences of a page that look like a result and are not marked."""
    for pattern in NOT_RESULTS:
        text = pattern.sub("", text)
    return [
        sentence
        for sentence in SENTENCE.split(WRAP.sub(" ", text))
        if RESULT.search(sentence) and not any(allowed in sentence for allowed in ALLOWED)
    ]


@pytest.mark.parametrize("page", [*filter(SEARCHED.fullmatch, PAGES)])
def test_no_result_is_printed_without_a_mark(page):
    if page not in THEORY:
        assert unmarked(PAGES[page]) == []


@pytest.mark.parametrize("page", [*filter(SEARCHED.fullmatch, MARKED)])
def test_a_result_that_loses_its_mark_is_found(page):
    assert unmarked(re.sub(r"<!--.*?-->", "", PAGES[page])) != []


def test_nothing_is_allowed_that_no_page_contains():
    text = WRAP.sub(" ", "\n\n".join(PAGES.values()))
    assert [allowed for allowed in ALLOWED if allowed not in text] == []
