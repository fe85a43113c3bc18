"""Tables as CSV with a line of titles: those of branch folders, and those that users write for us.

Tables of other programs, whose titles, units and separators vary, are read by
:mod:`limber.core.files.text_columns` (points) and :mod:`limber.recordings.tables` (over time).
"""

import contextlib
import csv
import io
import math
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from limber.core.errors import InputError
from limber.core.files.reading import are_moderate, read_text, unreadable

DIGITS = 9
"""Significant digits of a written number; poses in nanometres and nanoradians."""


def table_line(cells: Iterable[Any], digits: int = DIGITS) -> str:
    """Return a line of a table, without its end, of texts, whole numbers, and others with that many
    significant digits, of which NaN and None become empty."""
    text = io.StringIO()
    csv.writer(text, lineterminator="").writerow([_cell(cell, digits) for cell in cells])
    return text.getvalue()


def table_text(titles: Sequence[str], rows: Iterable[Iterable[Any]], digits: int = DIGITS) -> str:
    """Return a table with its titles, a line for each row as :func:`table_line` makes them."""
    return "".join(f"{table_line(row, digits)}\n" for row in (titles, *rows))


def write_table(path: str | os.PathLike, titles: Sequence[str], rows: Iterable[Iterable[Any]],
                digits: int = DIGITS, line_end: str = "\n") -> None:
    """Write a table as :func:`table_text` makes it, the same on every system."""
    Path(path).write_text(table_text(titles, rows, digits), encoding="utf-8", newline=line_end)


def csv_records(path: str | os.PathLike, what: str, comment: str = "") -> list[dict[str, Any]]:
    """Return the fields of each line of a CSV file, keyed by the titles in its first line; a
    missing one is None, those beyond are listed under None. Lines that begin with ``comment`` are
    skipped. InputError if it cannot be read, or a field has more than 131,072 characters."""
    lines = [line for line in read_text(path, what).splitlines()
             if not (comment and line.startswith(comment))]
    try:
        return list(csv.DictReader(lines))
    except csv.Error as error:
        raise unreadable(path, what, error) from error


def read_columns(path: str | os.PathLike, needed: Sequence[str], what: str,
                 ) -> dict[str, np.ndarray]:
    """Return the columns of a CSV file with a header that contain only finite numbers; InputError
    if it cannot be read, has no rows, or one of ``needed`` is not among them."""
    columns = {}
    for name, *values in zip(*csv_rows(path, what), strict=False):
        with contextlib.suppress(ValueError):
            numbers = np.array([float(value) for value in values])
            if are_moderate(numbers):
                columns[name.strip()] = numbers
    missing = [name for name in needed if not len(columns.get(name, ()))]
    if missing:
        raise InputError(f"{path} has no column {missing[0]} of finite numbers.",
                         f"{what[0].upper()}{what[1:]} was expected.",
                         "It is damaged, or was written by another program. Make it again.")
    return columns


def csv_rows(path: str | os.PathLike, what: str) -> list[list[str]]:
    """Return the fields of each line of a CSV file that is not empty; InputError as
    :func:`csv_records`."""
    try:
        return [row for row in csv.reader(read_text(path, what).splitlines()) if row]
    except csv.Error as error:
        raise unreadable(path, what, error) from error


def _cell(cell: Any, digits: int) -> str:
    if not isinstance(cell, float | np.floating):
        return "" if cell is None else str(cell)
    return "" if math.isnan(cell) else f"{cell:.{digits}g}"
