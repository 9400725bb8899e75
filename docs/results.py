"""Measured numbers of the pages: `results.json` holds them, and marks in the pages print them.

    python docs/results.py                   # render the pages
    python docs/results.py --check           # name each text that differs from the file
    python docs/results.py run compare map   # run the commands of sections, store, render
    python docs/results.py run ladder --workers tcp://HOST:8786              # on a cluster

A section of the file is one command: `command`, `commit` and `date` of its run, and `values`. The
command runs in a shell at the root of the repository and writes its values to $JSON. Its other
files belong in the folder build/$COMMIT, so that no run reuses those of other code. $WORKERS is the
option `--workers`, or empty; no value depends on it.

A mark is a comment without spaces, so that it counts no words:

- `<!--=PATH:FORMAT-->TEXT<!--/-->` prints a value, within a line: at its start Markdown would begin
  a block.
- `<!--table=PATH|CELL|CELL-->` on the line before a table prints a row for each object of a list,
  below the header of the page. A cell contains {PATH:FORMAT} of its object; its ~ is a space.

PATH is the section and the keys below `values`, joined by dots, with ~ for a space; in a list the
key is an index, the `name` of an object, or several with commas. FORMAT is Python's; a percent sign
gets a space. A list of numbers is `1 to 2`, an object with `survived` and `trials` `99 of 100`,
null `-`.
"""

import argparse
import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from datetime import date
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
FILE = ROOT / "docs" / "results.json"
PAGES = sorted(
    path
    for pattern in ("*.md", "docs/**/*.md", "benchmarks/*.md", "course/*.md", "hardware/*.md")
    for path in ROOT.glob(pattern)
)
MARK = re.compile(r"<!--=([\w.,~-]+):?([^>\s]*)-->([^<\n]*)<!--/-->")
TABLE = re.compile(
    r"^<!--table=([\w.,~-]+)((?:\|\S*?)+)-->\n(?:\|.*\n){2}((?:\|.*\n)*)", re.MULTILINE
)
STARTS = re.compile(r"^(?:[>*-] | )*<!--[=/].*", re.MULTILINE)
REST = re.compile(r"<!--(?:[=/]|table).*")
FIELD = re.compile(r"\{([^{}:]+):?([^}]*)\}")
LEAF = re.compile(r"\{[^{}]*\}|\[[^\[\]{}]*\]")


def value_at(values: Any, path: str) -> Any:
    """Return the value at a path below `values`; None below a null."""
    for key in path.replace("~", " ").split("."):
        if isinstance(values, list):
            named = {row.get("name"): row for row in values if isinstance(row, dict)}
            chosen = [
                named[name] if name in named else values[int(name)] for name in key.split(",")
            ]
            values = chosen if "," in key else chosen[0]
        elif values is not None:
            values = values[key]
    return values


def show(value: Any, form: str) -> str:
    """Return a value as the pages print it."""
    if value is None:
        return "-"
    if isinstance(value, dict):
        return f"{value['survived']:,} of {value['trials']:,}"
    if isinstance(value, list):
        *first, last = (show(row, form) for row in value)
        return " to ".join([*(text.removesuffix(" %") for text in first), last])
    return re.sub(r"^100\.0*%", "100%", format(value, form)).replace("%", " %")


def texts(page: str, results: dict[str, Any]) -> Iterator[tuple[str, tuple[int, int], str]]:
    """Return mark, place and text of everything that a page prints from the file.

    Raises:
        ValueError: A mark names no value, is damaged, or starts a line.
    """
    sections = {name: section["values"] for name, section in results.items()}
    try:
        for mark in MARK.finditer(page):
            path, form, _ = mark.groups()
            yield f"<!--={path}:{form}-->", mark.span(3), show(value_at(sections, path), form)
        for mark in TABLE.finditer(page):
            path, cells, _ = mark.groups()
            row = " | ".join(["", *cells[1:].replace("~", " ").split("|"), ""]).strip() + "\n"
            rows = [
                FIELD.sub(lambda field, of=of: show(value_at(of, field[1]), field[2]), row)
                for of in value_at(sections, path)
            ]
            yield f"<!--table={path}{cells}-->", mark.span(3), "".join(rows)
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise ValueError(f"{mark[0].splitlines()[0]}: no such value, {error!r}") from error
    if damaged := STARTS.search(page) or REST.search(TABLE.sub("", MARK.sub("", page))):
        raise ValueError(f"{damaged[0]} is damaged, or starts a line")


def render(page: str, results: dict[str, Any]) -> str:
    """Return a page with all texts of its marks from the file."""
    for _, (begin, end), text in sorted(texts(page, results), key=lambda row: -row[1][0]):
        page = page[:begin] + text + page[end:]
    return page


def differences(page: str, results: dict[str, Any]) -> list[str]:
    """Return a sentence for each text of a page that differs from the file."""
    return [
        f"{mark}: {page[begin:end]!r}, expected {text!r}"
        for mark, (begin, end), text in texts(page, results)
        if page[begin:end] != text
    ]


def write(results: dict[str, Any]) -> None:
    """Write the file, an innermost object or list in one line."""
    text = json.dumps(results, indent=1, sort_keys=True, ensure_ascii=False)
    FILE.write_text(LEAF.sub(lambda leaf: " ".join(leaf[0].split()), text) + "\n")


def rounded(number: str) -> float:
    """Return a number with the digits that are stored."""
    return float(f"{float(number):.6g}")


def run(command: str, workers: str) -> dict[str, Any]:
    """Run the command of a section; return what the section holds then.

    Args:
        command: The command.
        workers: Option of the command in place of its $WORKERS.
    """
    git = ("git", "-C", str(ROOT))
    commit = subprocess.check_output([*git, "rev-parse", "--short", "HEAD"], text=True).strip()
    code = ("src", "experiments", "benchmarks")
    commit += "+changes" * bool(subprocess.check_output([*git, "status", "--porcelain", *code]))
    (ROOT / "build" / commit).mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory() as folder:
        written = Path(folder) / "values.json"
        environment = os.environ | {"JSON": str(written), "COMMIT": commit, "WORKERS": workers}
        ended = subprocess.run(command, shell=True, cwd=ROOT, env=environment)
        if ended.returncode:
            sys.exit(f"exit code {ended.returncode} of {command}")
        values = json.loads(written.read_text(), parse_float=rounded)
    today = date.today().isoformat()
    return {"command": command, "commit": commit, "date": today, "values": values}


def main() -> None:
    """Do what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true", help="write nothing")
    parser.add_argument("--workers", metavar="tcp://HOST:8786", help="Dask scheduler of a cluster")
    parser.add_argument("names", nargs="*", metavar="run SECTION", help="by default all sections")
    args = parser.parse_args()
    results = json.loads(FILE.read_text())
    verb, *names = args.names or ["render"]
    if args.names and (verb != "run" or not results.keys() >= set(names)):
        parser.error(f"expected run and sections of {', '.join(results)}")
    workers = f"--workers {args.workers}" if args.workers else ""
    for name in names or results if verb == "run" else ():
        section = run(results[name]["command"], workers)
        results = json.loads(FILE.read_text())  # edited while the command ran
        write(results := results | {name: section})
    wrong: list[str] = []
    for path in PAGES:
        page, name = path.read_text(), path.relative_to(ROOT)
        try:
            if args.check:
                wrong += [f"{name}: {row}" for row in differences(page, results)]
            elif (new := render(page, results)) != page:
                path.write_text(new)
        except ValueError as error:
            wrong.append(f"{name}: {error}")
    sys.exit("\n".join(wrong) or None)


if __name__ == "__main__":
    main()
