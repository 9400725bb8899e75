"""The notebooks run as built; each check says *not solved* before its solution, *right* after.

A wrong answer is refused with a hint: the first notebook has one for each exercise.
"""

import re

import pytest

pytestmark = pytest.mark.full

jupytext = pytest.importorskip("jupytext", reason="jupytext is not installed (extra course)")
nbclient = pytest.importorskip("nbclient", reason="nbclient is not installed (extra course)")
notebooks = pytest.importorskip("course.notebooks")

FIRST = "0_first_balance"
NOTEBOOKS = sorted(path.stem for path in notebooks.COURSE.glob("[1-9]_*.py"))
LONGEST = 600.0
"""Time for a cell [s]."""
WRONG = (
    "w2 = 1.0",
    "def holds(seed):\n    return False",
    "friction = 'viscous'",
    "doubled_after = 1",
)
"""A wrong answer to each exercise of the first notebook."""
SAYS = re.compile(r"Exercise (\d+): (.*)")


def with_answers(name, wrong=()):
    """Return a notebook that checks each exercise as it is, with wrong answers, and solved."""
    book = notebooks.built(name)
    found = jupytext.read(notebooks.COURSE / "solutions" / f"{name}.py").cells
    code = [cell for cell in found if cell.cell_type == "code"]
    solutions = [cell for cell in code if "Solutions of" not in cell.source]
    wrong, cells, exercise = list(wrong), [], False
    for cell in book.cells:
        cells.append(cell)
        if "exercise" in cell.metadata.get("tags", ()):
            exercise = True
        elif exercise and "check(" in cell.source:
            if wrong:
                answer = cell.copy()
                answer.update(source=wrong.pop(0))
                cells += [answer, cell.copy()]
            cells += [solutions.pop(0), cell.copy()]
            exercise = False
    assert solutions == wrong == []
    for number, cell in enumerate(cells):
        cell["id"] = f"cell-{number}"
    book.cells = cells
    return book


def run(book, folder, answers):
    """Run a notebook; its checks say the answers to each exercise, and a figure is shown."""
    outputs = executed(book, folder)
    said = [found for output in outputs for found in SAYS.findall(output.get("text", ""))]
    assert len(said) >= 3 * len(answers)
    for i, (_, text) in enumerate(said):
        assert text.startswith(answers[i % len(answers)])
    assert any("image/png" in output.get("data", {}) for output in outputs)


def executed(book, folder):
    """Execute a notebook in an empty folder; return what its cells show."""
    nbclient.NotebookClient(
        book, timeout=LONGEST, kernel_name="python3", resources={"metadata": {"path": str(folder)}}
    ).execute()
    return [output for cell in book.cells for output in cell.get("outputs", ())]


def test_the_first_notebook_shows_a_film_of_what_it_trained(tmp_path, monkeypatch):
    monkeypatch.delenv("MPLBACKEND", raising=False)
    outputs = executed(notebooks.built(FIRST), tmp_path)
    assert "survived\n" in [output.get("text") for output in outputs]
    kinds = [kind for output in outputs for kind in output.get("data", {})]
    assert kinds.count("image/png") == 2
    assert "image/webp" in kinds


def test_colab_opens_each_notebook_in_the_repository_of_the_project():
    home = notebooks.PROJECT["urls"]["Repository"]
    address = home.replace("github.com", "colab.research.google.com/github")
    assert address != home
    for name in (FIRST, *NOTEBOOKS):
        assert f"]({address}/blob/notebooks/{name}.ipynb)" in notebooks.built(name).cells[0].source


@pytest.mark.parametrize(
    ("name", "wrong"),
    [(NOTEBOOKS[0], WRONG), *(pytest.param(n, (), marks=pytest.mark.slow) for n in NOTEBOOKS[1:])],
)
def test_a_notebook_runs(tmp_path, monkeypatch, name, wrong):
    monkeypatch.delenv("MPLBACKEND", raising=False)  # the kernel chooses the one of notebooks
    answers = ("not solved yet", "not yet", "right.") if wrong else ("not solved yet", "right.")
    run(with_answers(name, wrong), tmp_path, answers)
