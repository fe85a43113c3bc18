"""The lines of a table as text, split into fields, and the start of its numbers."""

import re
from pathlib import Path

import numpy as np

from limber.core.errors import InputError
from limber.recordings.table_parts.clocks import clock_seconds

_COLUMN = 20
"""Rows that make single numbers a column."""
_EMPTY = ("", "nan", "na", "n/a", "null", "none", "-")


def section_of(lines: list[str]) -> list[str]:
    """Return the lines that are not empty; of a Vicon file only its trajectories, of a LabVIEW file
    those below its headers.
    """
    ends = [k for k, line in enumerate(lines) if line.startswith("***End_of_Header***")]
    if ends:
        return [line for line in lines[ends[-1] + 1:] if line.strip()]
    begin = next((k for k, line in enumerate(lines)
                  if line.strip('",;\t \ufeff').lower() == "trajectories"), None)
    if begin is None:
        return [line for line in lines if line.strip()]
    end = next((k for k in range(begin, len(lines)) if not lines[k].strip(",;\t ")), len(lines))
    return lines[begin:end]


def is_clock(part: str) -> bool:
    """Return whether a field is a date or a time of day."""
    try:
        float(part.replace(",", "."))
    except ValueError:
        return clock_seconds(part) is not None
    return False


def text_of(path: Path) -> str:
    """Return the text of a file.

    Raises:
        InputError: it cannot be read, or is not text.
    """
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error}).", "A CSV file was expected.",
                         "Check the path and the file.") from error
    if raw[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return raw.decode("utf-16", errors="replace")
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = raw.decode("latin-1")
    if "\x00" in text:
        raise InputError(f"{path} is not a text file.", "A table of numbers was expected.",
                         "Export it as CSV.")
    return text


def separator_of(lines: list[str]) -> str | None:
    """Return the separator of the fields; None is white space."""
    sample = lines[-20:]
    for sign in ("\t", ";", ","):
        counts = [line.count(sign) for line in sample]
        # The last line may be truncated.
        if counts and np.median(counts) >= 1 and (
                np.mean(np.array(counts[:-1] or counts) == np.median(counts)) > 0.6):
            return sign
    return None


def fields_of(line: str, separator: str | None) -> list[str]:
    """Return the fields of a line without quotes."""
    # A unit in brackets belongs to the title before it.
    parts = line.split(separator) if separator else re.sub(r"\s+(?=[\[(])", "", line).split()
    return [part.strip().strip('"').strip() for part in parts]


def number_of(text: str, comma: bool) -> float | None:
    """Return a number, a date or time of day in seconds, NaN for an empty field, None for a word.

    Args:
        text: The field.
        comma: Whether decimals may be commas.
    """
    if text.lower() in _EMPTY:
        return np.nan
    try:
        number = float(text.replace(",", ".") if comma else text)
    except ValueError:
        return clock_seconds(text)
    return None if np.isinf(number) else number


def first_numbers(path: Path, rows: list[list[str]]) -> tuple[int, int]:
    """Return the index of the first row of numbers, and the number of its fields.

    Raises:
        InputError: there is none.
    """
    for index, row in enumerate(rows):
        words = words_in(row)
        known = [part for part in row if part.lower() not in _EMPTY]
        follows = rows[index + 1] if index + 1 < len(rows) else row
        # A preamble (NO_OF_FRAMES 600) also has numbers, but never two consecutive rows of several
        # numbers, nor words at the same positions twice.
        if (len(row) > 1 or _is_column(rows[index:index + _COLUMN])) and (
                len(known) - len(words) > len(row) // 2) and (
                not words or (words == words_in(follows) and len(words) <= len(row) // 3)) and (
                len(follows) == len(row) or index + 2 >= len(rows)):
            return index, len(row)
    raise InputError(f"{path} has no row of numbers." if rows else f"{path} is empty.",
                     "A header and rows of numbers were expected.",
                     "Check the file, or export it again.")


def _is_column(rows: list[list[str]]) -> bool:
    """Whether these are readings alone: a preamble has fewer single numbers below each other."""
    return len(rows) == _COLUMN and all(len(row) == 1 and not words_in(row) for row in rows)


def words_in(row: list[str]) -> list[int]:
    """Return which fields are neither numbers nor empty."""
    return [k for k, part in enumerate(row) if number_of(part, True) is None]
