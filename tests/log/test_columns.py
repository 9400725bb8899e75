"""The columns of the log: the page lists them, and rings take them by name."""

from pathlib import Path

import pytest

from equipoise.log.columns import TABLES

PAGE = Path(__file__).parents[2] / "docs" / "reference" / "run-log.md"


@pytest.mark.parametrize("table", TABLES)
def test_the_page_lists_the_columns_with_their_units(table):
    fields = [f"`{c.name}`" + (f" [{c.unit}]" if c.unit else "") for c in TABLES[table]]
    (row,) = [line for line in PAGE.read_text().splitlines() if line.startswith(f"| `/{table}`")]
    assert row.split("|")[3].strip().replace("²", "^2") == ", ".join(fields)
