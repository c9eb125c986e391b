"""The Parquet tables of a data set."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Float, Int


def parquet(table: pa.Table) -> bytes:
    """A table as a file."""
    data = io.BytesIO()
    pq.write_table(table, data, compression="snappy")
    return data.getvalue()


def frames_table(
    vectors: Mapping[str, Float[np.ndarray, "T _"]],
    numbers: Mapping[str, Int[np.ndarray, "T"]],
    times_s: Float[np.ndarray, "T"],
) -> pa.Table:
    """A row for each action.

    Args:
        vectors: by key, D of each.
        numbers: by key.
        times_s: since the beginning of the episode [s].
    """
    columns: dict[str, Any] = {
        key: pa.FixedSizeListArray.from_arrays(pa.array(rows.reshape(-1), pa.float32()), rows.shape[1])
        for key, rows in vectors.items()
    }
    columns["timestamp"] = pa.array(times_s, pa.float32())
    return pa.table({**columns, **{key: pa.array(values, pa.int64()) for key, values in numbers.items()}})


def tasks_table(tasks: Sequence[str]) -> pa.Table:
    """Each task's number, by its words.

    LeRobot reads it with pandas and takes the words from the index, of which pandas is told in the table's metadata.
    """
    index = "__index_level_0__"
    table = pa.table({"task_index": pa.array(range(len(tasks)), pa.int64()), index: pa.array(tasks, pa.string())})
    told = {
        "index_columns": [index],
        "column_indexes": [],
        "columns": [_column("task_index", "task_index", "int64"), _column(None, index, "unicode")],
        "pandas_version": "2.2.0",
    }
    return table.replace_schema_metadata({"pandas": json.dumps(told)})


def _column(name: str | None, field: str, kind: str) -> dict[str, Any]:
    numpy_type = "object" if kind == "unicode" else kind
    return {"name": name, "field_name": field, "pandas_type": kind, "numpy_type": numpy_type, "metadata": None}


def episodes_table(rows: Sequence[Mapping[str, Any]]) -> pa.Table:
    """A row for each episode; all rows have the same keys."""
    return pa.table({key: [row[key] for row in rows] for key in rows[0]})
