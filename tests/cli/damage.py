"""Files of ours, damaged in every way that a file can be."""

import json
import re

from equipoise.artefacts import value_digest


def cut(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def emptied(path):
    path.write_text("")


def flipped(path):
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0x80
    path.write_bytes(bytes(data))


def edited(path):
    """Change a number by hand, as somebody would who wants another one."""
    text = path.read_text()
    at = text.index('"value": ') if '"value": ' in text else text.index('"seed": ')
    digit = next(i for i in range(at, len(text)) if text[i].isdigit())
    path.write_text(text[:digit] + str((int(text[digit]) + 1) % 10) + text[digit + 1 :])


def newer(path):
    _rewrite(path, lambda document: document.update(version=document["version"] + 1))


def foreign(path):
    _rewrite(path, lambda document: document.update(format="somebody-elses"))


def other_json(path):
    path.write_text('{"w2": 70.2}')


def not_a_number(path):
    path.write_text(re.sub(r'"version": \d+', '"version": NaN', path.read_text(), count=1))


DAMAGE = {
    cut: "cut short",
    emptied: "not a file of Equipoise",
    flipped: "",
    edited: "does not match its digest",
    newer: "upgrade",
    foreign: "somebody-elses",
    other_json: "expected the keys format",
    not_a_number: "NaN is not allowed",
}
"""Ways to damage a file, and what the refusal has to say."""


def rebuilt(path, change):
    """Change the body and write a digest that fits, as a program would that knows the format."""

    def both(document):
        change(document["body"])
        document["digest"] = _digest(document["body"])

    _rewrite(path, both)


def _rewrite(path, change):
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))


def _digest(body):
    from pydantic import RootModel

    return value_digest(RootModel[dict](body))
