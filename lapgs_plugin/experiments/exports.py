"""Write and read results as files: tidy CSV and Parquet with one run a line, and tables."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lapgs_plugin.errors import MissingExtraError
from lapgs_plugin.files import atomic_write, one_line_errors

CSV, PARQUET, MARKDOWN, LATEX = "results.csv", "results.parquet", "tables.md", "tables.tex"

Row = Mapping[str, Any]


def write_csv(path: Path, rows: Sequence[Row]) -> None:
    """Write one line for each row; missing values are empty.

    Raises:
        RunFolderError: it cannot be written.
    """
    text = io.StringIO()
    writer = csv.DictWriter(text, columns_of(rows), restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    _write(path, text.getvalue().encode())


def write_parquet(path: Path, rows: Sequence[Row]) -> None:
    """Write rows with types; missing values are null.

    Raises:
        MissingExtraError: pyarrow is not installed.
        RunFolderError: it cannot be written.
    """
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise MissingExtraError(
            f"{path.name} is not written: pyarrow is not installed; pip install 'lapgs_plugin[parquet]'"
        ) from error
    table = pyarrow.table({name: [row.get(name) for row in rows] for name in columns_of(rows)})
    with one_line_errors(path), atomic_write(path) as stream:
        pyarrow.parquet.write_table(table, stream)


def write_text(path: Path, text: str) -> None:
    """Write a text file.

    Raises:
        RunFolderError: it cannot be written.
    """
    _write(path, text.encode())


def columns_of(rows: Sequence[Row]) -> list[str]:
    """Return the columns of all rows, in the order of their first appearance."""
    return list(dict.fromkeys(name for row in rows for name in row))


def read_csv(path: Path) -> list[dict[str, Any]]:
    """Read the rows of results.csv, with numbers as numbers and without empty values."""
    with path.open(newline="", encoding="utf-8") as stream:
        return [{name: _value(text) for name, text in row.items() if text != ""} for row in csv.DictReader(stream)]


def _value(text: str) -> Any:
    try:
        value = json.loads(text)
    except ValueError:
        return text
    return value if isinstance(value, (int, float)) else text


def _write(path: Path, data: bytes) -> None:
    with one_line_errors(path), atomic_write(path) as stream:
        stream.write(data)
