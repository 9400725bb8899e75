"""Build the notebooks of the course: each installs Equipoise in Colab, and brings its checks.

python course/notebooks.py build/site/course

Colab opens a notebook from a branch of the repository; the workflow of the documentation writes
what is built here to the branch `notebooks`.
"""

import sys
import tomllib
from pathlib import Path

import jupytext
from nbformat.v4 import new_code_cell, new_markdown_cell

COURSE = Path(__file__).parent
PROJECT = tomllib.loads((COURSE.parent / "pyproject.toml").read_text())["project"]
BADGE = "[![Open in Colab](https://colab.research.google.com/assets/colab-badge.svg)]({})"
INSTALL = """import sys

if "google.colab" in sys.modules:
    %pip install --quiet equipoise
    !apt-get install --quiet=2 libegl1 libgl1 > /dev/null"""


def colab(name: str) -> str:
    """Return the address at which Colab opens a notebook."""
    repository = PROJECT["urls"]["Repository"].removeprefix("https://github.com/")
    return f"https://colab.research.google.com/github/{repository}/blob/notebooks/{name}.ipynb"


def built(name: str):
    """Return a notebook that needs no other file."""
    book = jupytext.read(COURSE / f"{name}.py")
    checks = "%%writefile checks.py\n" + (COURSE / "checks.py").read_text()
    uses_checks = any("from checks import" in cell.source for cell in book.cells)
    book.cells[0:0] = [
        new_markdown_cell(BADGE.format(colab(name))),
        new_code_cell(INSTALL),
        *([new_code_cell(checks)] if uses_checks else []),
    ]
    for number, cell in enumerate(book.cells):  # equal builds are equal files
        cell["id"] = f"cell-{number}"
    book.metadata = {
        "kernelspec": {"name": "python3", "display_name": "Python 3", "language": "python"}
    }
    return book


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    for path in sorted(COURSE.glob("[0-9]_*.py")):
        jupytext.write(built(path.stem), folder / f"{path.stem}.ipynb")
