"""The columns of the log: the page lists them, and rings take them by name."""

from pathlib import Path

import numpy as np
import pytest

from equipoise.logs.columns import TABLES
from equipoise.logs.recorder import Recorder

PAGE = Path(__file__).parents[2] / "docs" / "reference" / "run-log.md"


@pytest.mark.parametrize("table", TABLES)
def test_the_page_lists_the_columns_with_their_units(table):
    fields = [f"`{c.name}`" + (f" [{c.unit}]" if c.unit else "") for c in TABLES[table]]
    (row,) = [line for line in PAGE.read_text().splitlines() if line.startswith(f"| `/{table}`")]
    assert row.split("|")[3].strip().replace("²", "^2") == ", ".join(fields)


def test_what_a_row_leaves_out_is_unknown_and_what_no_table_has_is_refused():
    recorder = Recorder(7)
    recorder.reply.push(time=1.0, torque=None)
    (row,) = recorder.reply.take()
    assert row["time"] == 1.0
    assert np.isnan([row["sent"], *row["q"], *row["torque"]]).all()
    with pytest.raises(ValueError, match="length"):
        recorder.reply.push(time=1.0, tau=2.0)
