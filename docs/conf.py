"""Settings of the documentation site: `make docs` builds it from the pages as they lie here.

The source folder is the root of the repository, so that the links of a page are the same on the
site and in a viewer of the repository. Links to files of code lead to pages that show the code.
"""

import ast
import re
import sys
from bisect import bisect_left, bisect_right
from collections.abc import Iterator
from importlib.metadata import version as version_of
from itertools import accumulate
from pathlib import Path
from pydoc import locate
from typing import Any, get_type_hints

from docutils import nodes
from latex2mathml.converter import convert
from pydantic import BaseModel
from pygments import highlight
from pygments.formatters import HtmlFormatter
from pygments.lexers import PythonLexer
from sphinx import addnodes
from sphinx.application import Sphinx

ROOT = Path(__file__).resolve().parents[1]
sys.path.append(str(ROOT))
from course.notebooks import colab  # noqa: E402

project = "Equipoise"
author = "The Equipoise developers"
project_copyright = author
version = release = version_of("equipoise")

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_copybutton"]
copybutton_prompt_text, copybutton_prompt_is_regexp = r">>> |\.\.\. ", True
root_doc = "docs/index"
include_patterns = [
    "README.md",
    "CHANGELOG.md",
    "CONTRIBUTING.md",
    "RELEASING.md",
    "SECURITY.md",
    "benchmarks/README.md",
    "course/README.md",
    "examples/README.md",
    "firmware/README.md",
    "hardware/README.md",
    "docs/**",
]
templates_path: list[str] = []
nitpicky = False

myst_heading_anchors = 4
myst_enable_extensions = ["dollarmath"]
API, DECISIONS = "docs/reference/api/README", "docs/decisions/README"
# A table of contents in the pages themselves would show as code where there is no site.
CONTENTS = {
    "Begin": [
        "Overview and results </README>",
        "/docs/tutorial",
        "/docs/how-to/play",
        "/course/README",
        "/examples/README",
    ],
    "How-to": [
        "/docs/how-to/your-own-pendulum",
        "/docs/how-to/encoder",
        "/docs/how-to/digital-twin",
        "/docs/how-to/swing-up",
        "/docs/how-to/series",
        "/docs/how-to/first-run",
        "/docs/how-to/franka",
        "/docs/how-to/console",
        "/docs/how-to/replay",
        "/docs/how-to/learn-from-the-robot",
        "/docs/how-to/real-time",
        "/docs/how-to/trouble",
        "/docs/how-to/change-the-reward",
        "/docs/how-to/bring-an-algorithm",
        "/docs/how-to/bring-a-policy",
        "/docs/how-to/bring-a-robot",
        "/docs/how-to/bring-an-arm",
        "/docs/how-to/bring-a-world",
        "/docs/how-to/coppeliasim",
        "/docs/how-to/scale",
        "/hardware/README",
        "/firmware/README",
    ],
    "Explanation": [
        "/docs/explanation/latency",
        "/docs/explanation/zero",
        "/docs/explanation/claims",
        "/docs/explanation/lqr",
        "/docs/explanation/sim-to-real-gap",
        "/docs/explanation/inside-the-cabinet",
        "/docs/explanation/dry-friction",
        "/docs/explanation/comparison",
        "/docs/safety-case",
    ],
    "Reference": [
        "/docs/reference/command-line",
        f"/{API}",
        "/docs/reference/paper",
        "/docs/deviations",
        "/docs/reference/environments",
        "/docs/reference/run-log",
        "/docs/reference/e-line",
        "/benchmarks/README",
    ],
    "Project": ["/CONTRIBUTING", "/SECURITY", "/RELEASING", "/CHANGELOG", f"/{DECISIONS}"],
}
"""Pages by part, in the order of the side bar."""

autodoc_member_order = "bysource"
autodoc_default_options = {"exclude-members": "model_config, model_post_init, FORMAT, VERSION"}
autodoc_typehints = "signature"
autodoc_preserve_defaults = True
python_use_unqualified_type_names = True
toc_object_entries_show_parents = "hide"
napoleon_google_docstring = True
napoleon_numpy_docstring = False

html_theme = "furo"
html_title = f"Equipoise {release}"
html_math_renderer = "mathml"
html_show_sourcelink = False
html_copy_source = False
html_static_path = ["site/site.css", "site/landing.css"]
html_css_files = ["site.css"]
html_extra_path = ["site/index.html"]
pygments_style = "friendly"

MARK = re.compile(r"<!--[=/]\S*?-->|<!--table=\S*?-->\n")
NOTEBOOK = re.compile(r"\[[^\]]*\]\((\d_\w+)\.py\)")
LINK = re.compile(r"(?<!!)\[([^\]]*)\]\(([^)#:]+)\)")
BACKTICKS = re.compile(r"(:[\w:]+:)?(?<!`)`([^`]+)`(?!`)(\w*)")
NAME = re.compile(r"[A-Za-z_][\w.]*")
FUNCTION = re.compile(r"<(?:function |class '(?:\w+\.)*)(\w+)(?: at \w+|')?>")
NUMBERS = re.compile(r"(?:[-–.,%\d\s]|of|to)+")
BARS = re.compile(r"\|(\w+)\|")
LIMITS = (("ge", "≥"), ("gt", ">"), ("le", "≤"), ("lt", "<"))
CODE = "code/{}"
ARRAY = re.compile(r"ndarray\[tuple\[Any, \.\.\.\], dtype\[(\w+)\]\]")


def add_contents(app: Sphinx, docname: str, source: list[str]) -> None:
    """Add the table of contents to the first page; remove marks of results and links to folders."""

    def freed(link: re.Match[str]) -> str:
        folder = Path(app.srcdir) / Path(docname).parent / link[2]
        return link[1] if folder.is_dir() else link[0]

    source[0] = LINK.sub(freed, MARK.sub("", source[0]))
    if docname == "course/README":
        source[0] = NOTEBOOK.sub(lambda name: f"{name[0]} ([Colab]({colab(name[1])}))", source[0])
    if docname == root_doc:
        for part, pages in CONTENTS.items():
            lines = "\n".join(pages)
            source[0] += f"\n```{{toctree}}\n:hidden:\n:caption: {part}\n\n{lines}\n```\n"
    if docname in (API, DECISIONS):
        source[0] += "\n```{toctree}\n:hidden:\n:glob:\n\n*\n```\n"


def drop_bounds(_app: Sphinx, function: Any, _bound: bool) -> None:
    """Show plain types without the bounds of `Annotated`, of a value the fields, too."""
    if "Annotated" in str(hints := getattr(function, "__annotations__", {})):
        hints.update(get_type_hints(function))


def simplify_model(
    _app: Sphinx, what: str, _name: str, obj: Any, _options: object, signature: Any, returns: Any
) -> tuple[Any, Any]:
    """Show the fields of a pydantic model once, as its members, with plain types."""
    if what != "class" or not issubclass(obj, BaseModel):
        return signature and FUNCTION.sub(r"\1", signature), returns
    own = {"__annotations__": obj.__annotations__, "__module__": obj.__module__}
    obj.__annotations__ = get_type_hints(type(obj.__name__, (), own))  # without Annotated
    return "", returns


def add_range(
    _app: Sphinx, _what: str, name: str, _obj: object, _options: object, lines: list[str]
) -> None:
    """Add default and range of a field of a pydantic model to its docstring."""
    parent, _, attribute = name.rpartition(".")
    field = getattr(locate(parent), "model_fields", {}).get(attribute)
    if field is None or field.is_required() or isinstance(field.default, BaseModel):
        return
    default = field.default
    default = f"{default:g}" if isinstance(default, float) else FUNCTION.sub(r"\1", repr(default))
    facts = [f"default ``{default}``"]
    for bound in field.metadata:
        facts += [f"{sign} {getattr(bound, key):g}" for key, sign in LIMITS if hasattr(bound, key)]
    lines[:] = [*"\n".join(lines).rstrip().split("\n"), f"({', '.join(facts)})", ""]


def read_backticks(
    _app: Sphinx, what: str, _name: str, _obj: object, _options: object, lines: list[str]
) -> None:
    """Turn `name` in a docstring into a link, other `code` into code, and |x| into a magnitude."""

    def marked(match: re.Match[str]) -> str:
        role, text, word = match.groups()
        if role:
            return match[0]
        tail = f"\\ {word}" if word else ""
        return (f":py:obj:`{text}`" if NAME.fullmatch(text) else f"``{text}``") + tail

    if what in ("attribute", "property"):
        lines.insert(0, "\\")  # else napoleon takes what stands before a colon for a type
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


def mark_numbers(_app: Sphinx, tree: nodes.document, _docname: str) -> None:
    """Mark the cells of tables that contain numbers only, which stay on one line."""
    for cell in tree.findall(nodes.entry):
        if NUMBERS.fullmatch(cell.astext()):
            cell["classes"].append("numbers")


def add_captions(_app: Sphinx, tree: nodes.document, _docname: str) -> None:
    """Show the text of a picture that stands alone below it."""
    for number, image in enumerate(list(tree.findall(nodes.image))):
        shown = image.parent if isinstance(image.parent, nodes.reference) else image
        paragraph = shown.parent
        if len(paragraph) == 1 and isinstance(paragraph.parent, nodes.section):
            caption = nodes.caption("", image["alt"])
            paragraph.replace_self(nodes.figure("", shown, caption, ids=[f"figure-{number}"]))


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


def style_first_page(app: Sphinx, docname: str, *_: Any) -> None:
    """Give the first page a layout of its own."""
    if docname == root_doc:
        app.add_css_file("landing.css")


def setup(app: Sphinx) -> dict[str, bool]:
    """Connect what is above."""
    app.add_html_math_renderer("mathml", (write_math, None), (write_math, None))
    app.connect("source-read", add_contents)
    app.connect("autodoc-before-process-signature", drop_bounds)
    app.connect("autodoc-process-signature", simplify_model)
    app.connect("autodoc-process-docstring", read_backticks, priority=100)  # before napoleon
    app.connect("autodoc-process-docstring", add_range)
    app.connect("doctree-resolved", link_code)
    app.connect("doctree-resolved", shorten_arrays)
    app.connect("doctree-resolved", mark_numbers)
    app.connect("doctree-resolved", add_captions)
    app.connect("html-page-context", style_first_page)
    app.connect("html-collect-pages", show_code)
    return {"parallel_read_safe": False}
