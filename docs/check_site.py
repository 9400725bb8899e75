"""Check a built site: links, files that a page loads from elsewhere, and Python's texts of objects.

python docs/check_site.py build/site
"""

import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

LOADS = {"img": "src", "script": "src", "link": "href", "iframe": "src", "source": "src"}
"""Attribute of an element through which a browser loads a file by itself."""
OBJECTS = ("<function ", "<class ", " at 0x", "Annotated[", "FieldInfo(")
"""Texts that Python gives objects, which say nothing to a reader."""


class Page(HTMLParser):
    """Links, loaded files and anchors of a page."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.links: list[str] = []
        self.loaded: list[str] = []
        self.anchors: set[str] = {""}
        self.text = ""
        self.feed(path.read_text())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Take note of an element."""
        found = {name: value for name, value in attrs if value}
        self.anchors |= {found[name] for name in ("id", "name") if name in found}
        if tag == "a" and "href" in found:
            self.links.append(found["href"])
        if tag in LOADS and LOADS[tag] in found:
            self.loaded.append(found[LOADS[tag]])

    def handle_data(self, data: str) -> None:
        """Take note of the text."""
        self.text += data


def faults(site: Path) -> list[str]:
    """Return what is wrong with a site, a sentence each."""
    pages = {path.resolve(): Page(path) for path in site.rglob("*.html")}
    found: list[str] = []
    for path, page in pages.items():
        name = path.relative_to(site.resolve())
        if "code" not in name.parts:  # files of code are shown as they are
            found += [f"{name} shows {text!r}" for text in OBJECTS if text in page.text]
        for address in (*page.links, *page.loaded):
            parts = urlsplit(address)
            if parts.scheme or parts.netloc:
                if address in page.loaded and parts.scheme != "data":
                    found.append(f"{name} loads {address}")
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            if not target.is_file():
                found.append(f"{name} links to {address}, which is not there")
            elif target in pages and unquote(parts.fragment) not in pages[target].anchors:
                found.append(f"{name} links to {address}, which has no such place")
    if not pages:
        found.append(f"there are no pages in {site}")
    return found


if __name__ == "__main__":
    broken = sorted(set(faults(Path(sys.argv[1]))))
    print("\n".join(broken) or "every link leads somewhere; nothing is loaded from elsewhere")
    sys.exit(bool(broken))
