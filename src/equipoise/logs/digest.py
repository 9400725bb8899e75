"""Digest of a run, which the end of its log holds."""

import hashlib
import json
from collections.abc import Mapping
from typing import Any

from equipoise.artefacts import DIGEST_PREFIX
from equipoise.logs.columns import TABLES, Rows
from equipoise.logs.conditions import RunConditions, RunEnd


class Digest:
    """SHA-256 of conditions, rows and end; each table has its own hash of its rows."""

    def __init__(self, conditions: RunConditions) -> None:
        """Begin with the conditions."""
        self._whole = hashlib.sha256(_json(conditions.model_dump(mode="json")))
        self._tables = {name: hashlib.sha256() for name in TABLES}

    def update(self, table: str, rows: Rows) -> None:
        """Add canonical rows of a table."""
        self._tables[table].update(rows.tobytes())

    def finish(self, end: RunEnd | None) -> str:
        """Return the digest of the added rows and the end."""
        for name, rows in self._tables.items():
            self._whole.update(name.encode() + rows.digest())
        self._whole.update(_json(end and end.model_dump(mode="json")))
        return DIGEST_PREFIX + self._whole.hexdigest()


def digest_of(conditions: RunConditions, rows: Mapping[str, Rows], end: RunEnd | None) -> str:
    """Return the SHA-256 of conditions, canonical rows and end."""
    digest = Digest(conditions)
    for name, table in rows.items():
        digest.update(name, table)
    return digest.finish(end)


def _json(content: Any) -> bytes:
    return json.dumps(content, separators=(",", ":"), sort_keys=True, allow_nan=False).encode()
