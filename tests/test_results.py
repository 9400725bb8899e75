"""What the pages print of the file of results is what the file says, and nothing is unmarked."""

import importlib.util
import json
from pathlib import Path

import pytest

from tests.cli.conftest import parse
from tests.test_pages import OTHERS, commands

ROOT = Path(__file__).parents[1]
spec = importlib.util.spec_from_file_location("results", ROOT / "docs" / "results.py")
results = importlib.util.module_from_spec(spec)
spec.loader.exec_module(results)

FILE = json.loads(results.FILE.read_text())
PAGES = {path.relative_to(ROOT).as_posix(): path.read_text() for path in results.PAGES}


@pytest.mark.parametrize("page", PAGES)
def test_a_page_prints_what_the_file_says(page):
    assert results.differences(PAGES[page], FILE) == []
    assert results.render(PAGES[page], FILE) == PAGES[page]


@pytest.mark.parametrize(
    ("page", "message"),
    [
        ("of <!--=map.slices.0.rat-->76<!--/-->", "no such value"),
        ("of <!--=map.slices.0.rate-->76", "damaged"),
        ("lasts\n<!--=map.slices.0.rate-->76<!--/--> s", "starts a line"),
    ],
)
def test_a_mark_that_would_print_nothing_is_refused(page, message):
    with pytest.raises(ValueError, match=message):
        results.render(page, FILE)


@pytest.mark.parametrize("section", FILE)
def test_the_command_of_a_section_exists(section):
    for name, *words in commands(FILE[section]["command"].replace("> $JSON", "")):
        if name == "equipoise":
            parse(words)
        elif name == "python":
            assert (ROOT / words[0]).is_file()
        else:
            assert name in OTHERS
