"""Commands and Python of every page: all are valid, all that need no other machine are run."""

import ast
import os
import re
import shlex
import sys
from importlib import import_module
from pathlib import Path

import pytest

import equipoise
from equipoise import shipped_policy, write_swing
from equipoise.reproduction.synthetic_swing import synthetic_swing
from tests.cli.conftest import parse
from tests.conftest import tiers
from tests.program import run_program
from tests.reference.onnx_network import FLOAT, linear_network

ROOT = Path(__file__).parents[1]
FOLDERS = ("benchmarks", "course", "examples", "firmware", "hardware")
PAGES = sorted(
    path.relative_to(ROOT).as_posix()
    for pattern in ("*.md", "docs/**/*.md", *(f"{name}/*.md" for name in FOLDERS))
    for path in ROOT.glob(pattern)
)
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
SHELL = re.compile(r"\s*(?:&&|\|\||;|\||\n)\s*(?:do\s)?")
OTHERS = {
    *("python", "pip", "make", "pre-commit", "jupyter", "jupytext", "docker", "podman"),
    *("sudo", "printf", "echo", "mkdir", "cd", "true", "for", "done", "."),
    *("arduino-cli", "dask", "ssh"),
}
"""Commands of other programs, whose options nothing here checks."""


def blocks(page, *languages):
    found = BLOCK.findall((ROOT / page).read_text())
    return [(language, text) for language, text in found if language in languages]


def commands(text):
    """The commands of a block, without comments, redirections and variables before them."""
    text = re.sub(r"\\\n\s*", " ", text)
    text = re.sub(r"(^|\s)#.*$", "", text, flags=re.MULTILINE)
    for line in SHELL.split(text):
        words = [word for word in shlex.split(line) if not re.fullmatch(r"[A-Z_]+=.*", word)]
        if words[:3] == ["python", "-m", "equipoise"]:
            words[:3] = ["equipoise"]
        if words:
            yield words


@pytest.mark.parametrize("page", PAGES)
def test_each_command_of_a_page_exists_with_its_options(page):
    for _, text in blocks(page, "sh"):
        for name, *words in commands(text):
            if name == "equipoise":
                parse(words)
            else:
                assert name.removesuffix("3") in OTHERS, name


def write(text, folder):
    """Write a block that names its file in its first line."""
    file = re.match(r"# (\S+\.(?:py|toml))\n", text)
    (folder / file[1]).write_text(text)


LINK = re.compile(r"\[`(\w+)`\]\((\S+?\.py)\)")


def test_the_map_of_the_paper_names_what_exists():
    page = ROOT / "docs" / "reference" / "paper.md"
    found = LINK.findall(page.read_text())
    assert len(found) > 30
    for name, link in found:
        path = (page.parent / link).resolve()
        module = path.relative_to(ROOT / "src").with_suffix("").as_posix().replace("/", ".")
        assert hasattr(import_module(module.removesuffix(".__init__")), name), (name, link)
        # The site jumps to the line where it is defined.
        assert re.search(rf"^(?:(?:def|class) )?{name}\b", path.read_text(), re.M), (name, link)


def test_the_page_for_trouble_quotes_what_the_code_prints():
    printed = []
    for path in (ROOT / "src").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            parts = node.values if isinstance(node, ast.JoinedStr) else [node]
            printed += ["".join(str(getattr(part, "value", "")) for part in parts)]
    for _, text in blocks("docs/how-to/trouble.md", "text"):
        for message in text.splitlines():
            quoted = re.compile(".*".join(map(re.escape, message.split("..."))))
            assert any(map(quoted.search, printed)), message


# The commands themselves.

ELSEWHERE = {
    r"pip install|pytest|pre-commit|make install|venv": "the environment that runs this",
    r"jupyter|jupytext": "tests/test_course.py opens the notebooks",
    r"sudo|printf|arduino-cli|list_ports": "changes or asks this computer's hardware",
    r"dask |tcp://": "needs a cluster: tests/test_executors.py",
    r"coppeliasim": "needs CoppeliaSim: tests/simulation/test_coppeliasim.py",
    r"kst://|serial://|doctor|fr3\.(toml|json)": "needs a rig: tests/robots, tests/rig, tests/cli",
    r"benchmarks/|experiments/": "tests/test_bench.py, tests/test_experiments.py",
    r"rl/|docker|podman": "needs what another page makes",
    r"^make ": "a step of the checks",
    r"hardware": "its own environment, or its files: hardware/tests",
}
"""Commands that are not run here, and why."""
SERVERS = re.compile(r"equipoise (?:play|console|log show|rig emulate)")
"""Commands that serve until Ctrl-C: tests/console and tests/cli run them."""
GUESTS = (
    "docs/how-to/change-the-reward.md",
    "docs/how-to/bring-an-algorithm.md",
    "docs/how-to/bring-a-policy.md",
)


def lines(text):
    """The lines of a block; a loop or a continued line is one of them."""
    text = re.sub(r"\\\n\s*", " ", text)
    text = re.sub(r"(?m)^(for .*; do)\n((?:  .*\n)+)done", _joined, text)
    text = re.sub(r"(?m)^python -m pip install [^&\n]+ && ", "", text)  # done before
    return [line for line in text.splitlines() if line.strip()]


def _joined(loop):
    return loop[1] + " " + "; ".join(line.strip() for line in loop[2].splitlines()) + "; done"


def runnable(line):
    return not SERVERS.search(line) and not any(re.search(e, line) for e in ELSEWHERE)


OWN_TESTS = [f"docs/how-to/bring-{what}.md" for what in ("an-arm", "a-robot", "a-world")]
"""Pages that a test of their own runs: test_bring_an_arm.py, test_guest.py and so on."""
RUN = [
    page
    for page in PAGES
    if any(runnable(line) for _, text in blocks(page, "sh") for line in lines(text))
    and page not in OWN_TESTS
]


@pytest.fixture
def folder(tmp_path):
    """What a reader of a page has: a swing, a policy, a log, files of other pages."""
    swing = synthetic_swing(seed=3)
    for name in ("swing.csv", "my_swing.csv"):
        write_swing(tmp_path / name, swing)
    shipped_policy().save(tmp_path / "policy.json", command="test")
    equipoise.shipped_pendulum().save(tmp_path / "pendulum.json", command="test")
    network = linear_network([[1.2], [1.8], [24.0], [3.0]], element=FLOAT)
    (tmp_path / "network.onnx").write_bytes(network)
    law = "return 24.0 * observation[2] + 3.0 * observation[3]"
    (tmp_path / "my_module.py").write_text(f"def my_function(observation):\n    {law}\n")
    for page, file in (("first-run.md", "rig.toml"), ("digital-twin.md", "mine.toml")):
        ((_, text),) = blocks(f"docs/how-to/{page}", "toml")
        (tmp_path / file).write_text(text)
    return tmp_path


@pytest.mark.parametrize("page", tiers(RUN, (), GUESTS))
def test_the_commands_of_a_page_run(page, folder):
    """Each as it is printed, one after the other, in one folder. A bad result is code 1."""
    bin_folder = Path(sys.executable).parent
    environment = os.environ | {"PATH": f"{bin_folder}{os.pathsep}{os.environ['PATH']}"}

    def shell(line):
        return run_program("bash", "-c", line, cwd=folder, env=environment, check=False)

    for log in ("run.mcap", "other-run.mcap"):
        line = f"equipoise deploy policy.json --duration 10 --world twin:nominal --out {log}"
        assert shell(line).returncode == 0
    done = 0
    for language, text in blocks(page, "python", "sh"):
        if language == "python":
            if text.startswith("# "):
                write(text, folder)
            continue
        for line in lines(text):
            if not runnable(line):
                continue
            ran = shell(line if re.match("for|cd|mkdir|echo|python", line) else forced(line))
            assert ran.returncode in (0, 1), (line, ran.stdout[-2000:], ran.stderr[-2000:])
            assert "Traceback" not in ran.stderr
            done += 1
    assert done


def forced(line):
    """Let a command replace the files of an earlier block of its page, if it can."""
    first = line.split("#")[0].rstrip()
    words = shlex.split(first.split("&&")[0].split("||")[0])[1:]
    if words[:1] == ["-m"]:
        words = words[2:]
    known = "force" in parse(words)
    return re.sub(r"( &&| \|\||$)", r" --force\1", first, count=1) if known else first
