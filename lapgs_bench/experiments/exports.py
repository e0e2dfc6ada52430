"""Write and read results as files: tidy CSV and Parquet with one run a line, and tables."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lapgs_plugin.errors import RunFolderError, UserInputError, require_extra
from lapgs_plugin.files import atomic_write, one_line_errors, write_text
from lapgs_plugin.untrusted import parse_json, require_regular, shortened

CSV, PARQUET, MARKDOWN, LATEX = "results.csv", "results.parquet", "tables.md", "tables.tex"
NAMES = ("variant", "baseline", "run", "scene", "backbone")
"""Columns of names, which every row has; one such as 0.50 is no number."""

Row = Mapping[str, Any]
"""Row of results, see `rows`."""


def write_csv(path: Path, rows: Sequence[Row]) -> None:
    """Write one line for each row; missing values are empty.

    Raises:
        RunFolderError: it cannot be written.
    """
    text = io.StringIO()
    writer = csv.DictWriter(text, columns_of(rows), restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_text(path, text.getvalue())


def write_parquet(path: Path, rows: Sequence[Row]) -> None:
    """Write rows with types; missing values are null.

    Raises:
        MissingExtraError: pyarrow is not installed.
        RunFolderError: it cannot be written.
    """
    require_extra("pyarrow", "parquet", path.name)
    import pyarrow
    import pyarrow.parquet

    try:
        table = pyarrow.table({name: [row.get(name) for row in rows] for name in columns_of(rows)})
    except (pyarrow.ArrowException, OverflowError) as error:
        raise RunFolderError(
            f"{path} is not written: runs differ in the type of a figure ({shortened(str(error))}); run the experiment "
            "again in another folder"
        ) from error
    with one_line_errors(path), atomic_write(path) as stream:
        pyarrow.parquet.write_table(table, stream)


def columns_of(rows: Sequence[Row]) -> list[str]:
    """Return the columns of all rows, in the order of their first appearance."""
    return list(dict.fromkeys(name for row in rows for name in row))


def read_csv(path: Path) -> list[dict[str, Any]]:
    """Read the rows of results.csv, with numbers as numbers, names as text, and without empty values.

    Raises:
        OSError: the file cannot be read.
        ValueError: the file is not such a table.
    """
    require_regular(path)
    with path.open(newline="", encoding="utf-8") as stream:
        reader = csv.DictReader(stream)
        try:
            rows = list(reader)
        except csv.Error as error:
            raise ValueError(str(error)) from error
    expected = set(reader.fieldnames or ())
    for number, row in enumerate(rows, start=1):
        if row.keys() != expected or None in row.values():
            raise ValueError(f"row {number} has more or fewer cells than the {len(expected)} of the first line")
    return [{name: text if name in NAMES else _value(text) for name, text in row.items() if text != ""} for row in rows]


def _value(text: str) -> Any:
    try:
        value = parse_json(text, "a cell", advice="")
    except UserInputError:
        return text
    return value if isinstance(value, (int, float)) else text
