"""Settings of the documentation site: `make docs` builds it from the pages as they lie here.

The source folder is the root of the repository, so that the links of a page are the same on the
site and in a viewer of the repository. Links to files of code lead to pages that show the code.
"""

import ast
import re
from bisect import bisect_left, bisect_right
from collections.abc import Iterator
from importlib.metadata import version as version_of
from itertools import accumulate
from pathlib import Path
from typing import Any

from docutils import nodes
from latex2mathml.converter import convert
from pygments import highlight
from pygments.formatters import HtmlFormatter
from pygments.lexers import PythonLexer
from sphinx import addnodes
from sphinx.application import Sphinx

ROOT = Path(__file__).resolve().parents[1]

project = "Equipoise"
author = "The Equipoise developers"
project_copyright = author
version = release = version_of("equipoise")

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
root_doc = "docs/index"
include_patterns = [
    "README.md",
    "CHANGELOG.md",
    "CONTRIBUTING.md",
    "benchmarks/README.md",
    "course/README.md",
    "firmware/README.md",
    "docs/**",
]
templates_path: list[str] = []
nitpicky = False

myst_heading_anchors = 4
myst_enable_extensions = ["dollarmath"]
DECISIONS = "docs/decisions/README"
# A table of contents in the pages themselves would show as code where there is no site.
CONTENTS = {
    "Begin": [
        "Overview and results </README>",
        "/docs/tutorial",
        "/docs/how-to/play",
        "/course/README",
    ],
    "How-to": [
        "/docs/how-to/your-own-pendulum",
        "/docs/how-to/encoder",
        "/docs/how-to/digital-twin",
        "/docs/how-to/first-run",
        "/docs/how-to/console",
        "/docs/how-to/replay",
        "/docs/how-to/learn-from-the-robot",
        "/docs/how-to/real-time",
        "/docs/how-to/change-the-reward",
        "/docs/how-to/bring-a-learner",
        "/docs/how-to/bring-a-policy",
        "/docs/how-to/bring-a-robot",
        "/docs/how-to/bring-an-arm",
        "/docs/how-to/bring-a-world",
        "/docs/how-to/sweep",
        "/docs/how-to/coppeliasim",
        "/firmware/README",
    ],
    "Explanation": [
        "/docs/explanation/latency",
        "/docs/explanation/zero",
        "/docs/explanation/certificates",
        "/docs/explanation/lqr",
        "/docs/explanation/sim-to-real-gap",
        "/docs/explanation/inside-the-cabinet",
        "/docs/explanation/dry-friction",
        "/docs/explanation/comparison",
        "/docs/safety-case",
    ],
    "Reference": [
        "/docs/reference/command-line",
        "/docs/reference/api",
        "/docs/reference/paper",
        "/docs/deviations",
        "/docs/reference/environments",
        "/docs/reference/run-log",
        "/docs/reference/e-line",
        "/benchmarks/README",
    ],
    "Project": ["/CONTRIBUTING", "/CHANGELOG", f"/{DECISIONS}"],
}
"""Pages by part, in the order of the side bar."""

autodoc_member_order = "bysource"
autodoc_default_options = {"exclude-members": "model_config, model_post_init, FORMAT, VERSION"}
autodoc_typehints = "signature"
autodoc_preserve_defaults = True
python_use_unqualified_type_names = True
napoleon_google_docstring = True
napoleon_numpy_docstring = False

html_theme = "furo"
html_title = f"Equipoise {release}"
html_math_renderer = "mathml"
html_show_sourcelink = False
html_copy_source = False
html_static_path = ["site.css"]
html_css_files = ["site.css"]
html_extra_path = ["site/index.html"]
pygments_style = "friendly"

LINK = re.compile(r"(?<!!)\[([^\]]*)\]\(([^)#:]+)\)")
BACKTICKS = re.compile(r"(?<![:`])`([^`]+)`(?!`)(\w*)")
NAME = re.compile(r"[A-Za-z_][\w.]*")
BARS = re.compile(r"\|(\w+)\|")
CODE = "code/{}"
ARRAY = re.compile(r"ndarray\[tuple\[Any, \.\.\.\], dtype\[(\w+)\]\]")


def add_contents(app: Sphinx, docname: str, source: list[str]) -> None:
    """Add the table of contents to the first page, and free links to folders of their targets."""

    def freed(link: re.Match[str]) -> str:
        folder = Path(app.srcdir) / Path(docname).parent / link[2]
        return link[1] if folder.is_dir() else link[0]

    source[0] = LINK.sub(freed, source[0])
    if docname == root_doc:
        for part, pages in CONTENTS.items():
            lines = "\n".join(pages)
            source[0] += f"\n```{{toctree}}\n:hidden:\n:caption: {part}\n\n{lines}\n```\n"
    if docname == DECISIONS:
        source[0] += "\n```{toctree}\n:hidden:\n:glob:\n\n*\n```\n"


def read_backticks(
    _app: Sphinx, what: str, _name: str, _obj: object, _options: object, lines: list[str]
) -> None:
    """Turn `name` in a docstring into a link, other `code` into code, and |x| into a magnitude."""

    def marked(match: re.Match[str]) -> str:
        text, tail = match[1], "\\ " + match[2] if match[2] else ""
        return (f":py:obj:`{text}`" if NAME.fullmatch(text) else f"``{text}``") + tail

    if what == "attribute":
        lines.insert(0, "")  # else napoleon takes what stands before a colon for a type
    lines[:] = [BARS.sub(r"\\|\1\\|", BACKTICKS.sub(marked, line)) for line in lines]


def link_code(app: Sphinx, tree: nodes.document, docname: str) -> None:
    """Let links to Python files lead to pages that show them, at the object that the link names."""
    shown: set[str] = app.env.__dict__.setdefault("equipoise_shown", set())
    for link in list(tree.findall(addnodes.download_reference)):
        target = link["reftarget"]
        folder = ROOT if target.startswith("/") else ROOT / Path(docname).parent
        path = (folder / target.lstrip("/")).resolve()
        if path.suffix != ".py" or not path.is_relative_to(ROOT):
            continue
        name = path.relative_to(ROOT).as_posix()
        shown.add(name)
        line = line_of(path, link.astext())
        page = app.builder.get_relative_uri(docname, CODE.format(name))
        reference = nodes.reference("", "", refuri=page + (f"#line-{line}" if line else ""))
        reference += link.children
        link.replace_self(reference)


def shorten_arrays(_app: Sphinx, tree: nodes.document, _docname: str) -> None:
    """Show types of arrays as the code has them, such as NDArray[float64]."""
    for signature in tree.findall(addnodes.desc_signature):
        for element in list(signature.findall(nodes.Element)):
            texts = [child.astext() for child in element.children]
            if any(map(ARRAY.search, texts)):
                continue  # inside a child
            while found := ARRAY.search("".join(texts)):
                ends = list(accumulate(map(len, texts)))
                span = slice(bisect_right(ends, found.start()), bisect_left(ends, found.end()) + 1)
                name = f"NDArray[{found[1]}]"
                element[span], texts[span] = [addnodes.desc_sig_name(name, name)], [name]


def line_of(path: Path, name: str) -> int:
    """Return the line of an object of a file, such as `Pendulum.save`; 0 if it has none."""
    body, line = ast.parse(path.read_text()).body, 0
    for word in name.split("."):
        for node in body:
            targets = getattr(node, "targets", [getattr(node, "target", None)])
            if word in (getattr(node, "name", None), *(getattr(t, "id", None) for t in targets)):
                line, body = node.lineno, getattr(node, "body", [])
                break
        else:
            return 0
    return line


def show_code(app: Sphinx) -> Iterator[tuple[str, dict[str, Any], str]]:
    """Make the pages of code that are linked."""
    for name in sorted(app.env.__dict__.get("equipoise_shown", ())):
        form = HtmlFormatter(linenos="inline", lineanchors="line", anchorlinenos=True)
        code = highlight((ROOT / name).read_text(), PythonLexer(), form)
        yield CODE.format(name), {"title": name, "body": f"<h1>{name}</h1>{code}"}, "page.html"


def write_math(self: Any, node: nodes.Element) -> None:
    """Write a formula as MathML, which browsers show without a script."""
    block = isinstance(node, nodes.math_block)
    formula = convert(node.astext(), display="block" if block else "inline")
    self.body.append(f"<p>{formula}</p>" if block else formula)
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, bool]:
    """Connect what is above."""
    app.add_html_math_renderer("mathml", (write_math, None), (write_math, None))
    app.connect("source-read", add_contents)
    app.connect("autodoc-process-docstring", read_backticks, priority=100)  # before napoleon
    app.connect("doctree-resolved", link_code)
    app.connect("doctree-resolved", shorten_arrays)
    app.connect("html-collect-pages", show_code)
    return {"parallel_read_safe": False}
