"""Files: what is written is read back, and what is not that is refused with one sentence."""

import hashlib
import json
import os
import sys
from pathlib import Path
from typing import ClassVar, Literal

import pytest

from equipoise import read_swing, read_urdf, resolve
from equipoise.errors import ArtefactError, InputError, OutsideError
from equipoise.files import Artefact, Value, read_document, reserved, value_digest


class Part(Value):
    """A part of a gauge."""

    size: float
    kind: Literal["round", "square"] = "round"


class Gauge(Artefact):
    """A made-up artefact."""

    FORMAT: ClassVar[str] = "test-gauge"

    label: str
    count: int = 0
    row: tuple[float, ...] = ()
    part: Part | None = None


GAUGE = Gauge(label="Ä 'b' \"c\"\n", count=3, row=(0.1, -0.0, 1e-300), part=Part(size=2.5))


def canonical_digest(body):
    """Return the digest as a reader in another language would compute it."""
    text = json.dumps(body, sort_keys=True, separators=(",", ":"))
    return "sha256:" + hashlib.sha256(text.encode("ascii")).hexdigest()


def signed(body):
    """Return the text of a file whose digest is right."""
    digest = canonical_digest(body)
    document = {"format": "test-gauge", "digest": digest, "provenance": {}, "body": body}
    return json.dumps(document)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "gauge.json"


@pytest.fixture
def saved(path):
    GAUGE.save(path, command="test", inputs={"swing": "sha256:0"})
    return path


def refusal(path, content):
    """Return the sentence with which a file is refused."""
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(ArtefactError) as refused:
        Gauge.load(path)
    message = str(refused.value)
    assert str(path) in message
    assert "\n" not in message
    return message


# What is written


def test_the_digest_is_the_sha256_of_the_canonical_json_of_the_body(saved):
    document = json.loads(saved.read_text())
    assert document["digest"] == canonical_digest(document["body"]) == GAUGE.digest
    assert value_digest(GAUGE) == GAUGE.digest
    read = Gauge.load(saved)
    assert (read, read.digest) == (GAUGE, GAUGE.digest)
    # As hexadecimal, since -0.0 == 0.0.
    assert [number.hex() for number in read.row] == [number.hex() for number in GAUGE.row]


def test_a_file_says_what_it_is_and_where_it_comes_from(saved):
    document = read_document(saved)
    assert list(document) == ["format", "digest", "provenance", "body"]
    assert document["format"] == "test-gauge"
    provenance = document["provenance"]
    assert provenance["command"] == "test"
    assert provenance["inputs"] == {"swing": "sha256:0"}
    assert provenance["created"].endswith("+00:00")
    assert {"equipoise", "python", "numpy", "numba"} <= set(provenance["software"])


ROBOT = (Path(__file__).parent / "data" / "elbow6.urdf").read_text(encoding="utf-8")
TEXTS = {
    "toml": ("[learning]\ngamma = 0.5\n", lambda path: resolve(file=path).learning.gamma),
    "csv": ("time_s,theta_rad\n0,0.1\n1,0.2\n", lambda path: read_swing(path).theta.tolist()),
    "json": (signed({"label": "Ä"}), lambda path: Gauge.load(path).label),
    "urdf": (ROBOT, lambda path: read_urdf(path).digest),
}
"""Text of a file of each kind, and what is read of it."""


@pytest.mark.parametrize("kind", TEXTS)
def test_every_text_file_is_read_with_and_without_a_byte_order_mark(tmp_path, kind):
    text, read = TEXTS[kind]
    path, found = tmp_path / f"one.{kind}", []
    for codec in ("utf-8", "utf-8-sig"):
        path.write_text(text, encoding=codec)
        found.append(read(path))
    assert found[0] == found[1]
    for codec in ("utf-16", "utf-32"):
        path.write_text(text, encoding=codec)
        with pytest.raises(InputError, match="one.* is not text in UTF-8; give a"):
            read(path)


# What is refused


FOREIGN = (b"", b"hello", b"\xff{}", b"null", b"{}", b"[" * 100_000)


def test_what_is_no_file_of_equipoise_is_refused(tmp_path, saved):
    whole = json.loads(saved.read_text())
    for missing in (tmp_path / "nowhere.json", tmp_path):
        with pytest.raises(ArtefactError):
            Gauge.load(missing)
    for key in whole:
        refusal(saved, json.dumps({k: value for k, value in whole.items() if k != key}))
    for content in FOREIGN:
        refusal(saved, content)


@pytest.mark.parametrize(
    ("old", "new"), [('"count": 3', '"count": 4'), ("0.1", "0.10000000000000002"), ("2.5", "NaN")]
)
def test_an_edited_file_is_refused(saved, old, new):
    text = saved.read_text()
    assert old in text
    refusal(saved, text.replace(old, new))


@pytest.mark.parametrize(
    ("change", "where"),
    [
        ({"colour": "red"}, "colour"),
        ({"count": "3"}, "count"),
        ({"part": {"size": 1.0, "width": 2.0}}, "part.width"),
    ],
)
def test_a_body_that_does_not_fit_is_refused_and_says_where(path, change, where):
    assert where in refusal(path, signed({"label": "a"} | change))


# Whole or not at all


def failing(*_, **__):
    raise OSError(28, "No space left on device")


@pytest.mark.parametrize("step", ["fsync", "replace"])
def test_a_disk_that_fails_leaves_what_was_there_and_nothing_else(tmp_path, monkeypatch, step):
    path = tmp_path / "gauge.json"
    path.write_text("before")
    monkeypatch.setattr(*((os, step) if step == "fsync" else (Path, step)), failing)
    with pytest.raises(OutsideError, match="No space left on device"):
        GAUGE.save(path, command="test")
    assert [file.name for file in tmp_path.iterdir()] == ["gauge.json"]
    assert path.read_text() == "before"


def test_without_file_locks_no_name_is_reserved(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "fcntl", None)
    with pytest.raises(OutsideError, match="in WSL 2: see"), reserved([tmp_path / "run.mcap"]):
        raise AssertionError
