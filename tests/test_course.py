"""The notebooks of the course run.

Each check says *not solved* before, *not yet* to a wrong answer, *right* to the solution.
"""

import re
import shutil
import time
from pathlib import Path

import pytest

jupytext = pytest.importorskip("jupytext", reason="jupytext is not installed (extra course)")
nbclient = pytest.importorskip("nbclient", reason="nbclient is not installed (extra course)")

COURSE = Path(__file__).parents[1] / "course"
NOTEBOOKS = sorted(path.stem for path in COURSE.glob("[0-9]_*.py"))
LONGEST = 600.0
"""Time for all notebooks together, with their exercises run unsolved and solved [s]."""
WRONG = {
    "1_pendulum": (
        "w2 = 2 * pi / 0.75",
        "def holds(seed):\n    return False",
        "friction = 'viscous'",
        "doubled_after = 0.03",
    ),
    "2_q_learning": (
        "numbers = 270",
        "def moved(value, reward, values_next, alpha, gamma):\n    return value",
        "first = points[0].episodes",
        "share = np.mean(trained.u_of_box == trained.u_of_box[::-1])",
    ),
    "3_reality": (
        "growth = 70.2 * 0.03",
        "at_the_end = 'on the track'",
        "worst = max(seconds, key=seconds.get)",
        "certain = set(alone)",
    ),
    "4_prediction": (
        "def predicted(phi, phi_dot, w, T):\n    return phi + phi_dot * T, phi_dot",
        "bound = 0.95",
        "trials = 298",
        "allowed = 0",
    ),
    "5_your_learner": (
        "RULE = RULE.replace('...', 'transition.discount * best_value(tables.Q, 1)')",
        "gains = survival['q_learning'] - survival[mine]",
        "trainings = 5",
    ),
}
"""A wrong answer to each exercise; the check refuses it with a hint."""
SAYS = re.compile(r"Exercise (\d+): (.*)")


def as_given(name):
    """Return a notebook with its exercises unsolved."""
    book = jupytext.read(COURSE / f"{name}.py")
    for number, cell in enumerate(book.cells):
        cell["id"] = f"cell-{number}"
    return book


def with_answers(name):
    """Return a notebook that checks each exercise as it is, with a wrong answer, and solved."""
    book = jupytext.read(COURSE / f"{name}.py")
    found = jupytext.read(COURSE / "solutions" / f"{name}.py").cells
    solutions = [
        cell for cell in found if cell.cell_type == "code" and "Solutions of" not in cell.source
    ]
    wrong, cells, exercise = list(WRONG[name]), [], None
    for cell in book.cells:
        cells.append(cell)
        if "exercise" in cell.metadata.get("tags", ()):
            exercise = cell
        elif exercise is not None and "check(" in cell.source:
            answer = cell.copy()
            answer.update(source=wrong.pop(0), metadata={})
            cells += [answer, cell.copy(), solutions.pop(0), cell.copy()]
            exercise = None
    assert solutions == wrong == []
    assert exercise is None
    for number, cell in enumerate(cells):
        cell["id"] = f"cell-{number}"
    book.cells = cells
    return book


def run(book, folder):
    """Run a notebook; return it, with its outputs, and what the checks said."""
    shutil.copy(COURSE / "checks.py", folder)
    nbclient.NotebookClient(
        book, timeout=LONGEST, kernel_name="python3", resources={"metadata": {"path": str(folder)}}
    ).execute()
    said = [SAYS.findall(text) for text in map(printed, book.cells)]
    return book, [found[0] for found in said if found]


def printed(cell):
    return "".join(output.get("text", "") for output in cell.get("outputs", ()))


def assert_taught(said):
    """Each exercise: first it is not solved, then wrong, and with its solution right."""
    assert len(said) >= 9
    assert len(said) % 3 == 0
    for (number, before), (same, wrong), (last, after) in zip(*[iter(said)] * 3, strict=True):
        assert number == same == last
        assert before.startswith("not solved yet")
        assert wrong.startswith("not yet")
        assert after == "right."


def forms(book):
    """Return the forms in which values and figures are shown."""
    outputs = [output for cell in book.cells for output in cell.get("outputs", ())]
    return {form for output in outputs for form in output.get("data", {})}


def assert_shown(book):
    """Values and figures appear as such, without the text of a forgotten return value above."""
    assert "image/png" in forms(book)
    outputs = [output for cell in book.cells for output in cell.get("outputs", ())]
    texts = [output.get("data", {}).get("text/plain", "") for output in outputs]
    assert not [text for text in texts if re.search(r"Text\(|<matplotlib", text)]


@pytest.mark.compiled_only
def test_the_first_notebook_runs(tmp_path, monkeypatch):
    monkeypatch.delenv("MPLBACKEND", raising=False)  # the kernel chooses the one of notebooks
    book, said = run(with_answers(NOTEBOOKS[0]), tmp_path)
    assert_taught(said)
    assert_shown(book)


def test_each_notebook_has_its_solutions():
    assert len(NOTEBOOKS) == 5
    assert all(with_answers(name) for name in NOTEBOOKS)


@pytest.mark.slow
@pytest.mark.compiled_only
def test_all_notebooks_run_within_ten_minutes(tmp_path, monkeypatch):
    monkeypatch.delenv("MPLBACKEND", raising=False)
    begun = time.monotonic()
    for name in NOTEBOOKS:
        book, said = run(with_answers(name), tmp_path)
        assert_taught(said)
        assert_shown(book)
    assert time.monotonic() - begun < LONGEST


@pytest.mark.slow
@pytest.mark.compiled_only
@pytest.mark.parametrize("name", NOTEBOOKS)
def test_a_notebook_runs_to_its_end_without_a_solved_exercise(name, tmp_path):
    _, said = run(as_given(name), tmp_path)
    assert len(said) >= 3
    assert all(answer.startswith("not solved yet") for _, answer in said)
