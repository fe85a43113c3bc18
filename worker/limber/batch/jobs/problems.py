"""The problems of a job file: collected, and reported together, each with its line."""

from pathlib import Path
from typing import Any

from limber.batch.jobs.toml_positions import KeyPath, line_of
from limber.core.errors import InputError
from limber.core.settings import nearest

_SHOWN = 12
_KINDS = {str: "a text", int: "a whole number", list: "a list"}


class Problems:
    """The problems of one file; ``lines`` gives the line of each key."""

    def __init__(self, path: Path, lines: dict[KeyPath, int]):
        self._path, self._lines = path, lines
        self._found: list[tuple[int, str]] = []

    def add(self, key_path: KeyPath, text: str) -> None:
        self._found.append((line_of(self._lines, key_path), text))

    def stop(self) -> None:
        """Raise an InputError that lists them, if there are any."""
        if not self._found:
            return
        messages = [f"{self._path}, line {line}: {text}"
                    for line, text in sorted(dict.fromkeys(self._found))]
        more = len(messages) - _SHOWN
        raise InputError("\n".join(messages[:_SHOWN]) + (
            f"\nand {more} more." if more > 0 else ""), "", "Nothing was run.")

    def check_keys(self, table: dict[str, Any], known: tuple[str, ...], key_path: KeyPath) -> None:
        for key in table:
            if key not in known:
                self.add((*key_path, key), f"{key!r} is unknown here. {nearest(key, known)}")

    def typed(self, table: dict[str, Any], key: str, kind: type, key_path: KeyPath,
              otherwise: Any) -> Any:
        """Return a value of this kind; ``otherwise`` if it is missing or has another type."""
        value = table.get(key, otherwise)
        if value is not otherwise and (not isinstance(value, kind) or isinstance(value, bool)):
            self.add((*key_path, key), f"{key} is {value!r}, but must be {_KINDS[kind]}.")
            return otherwise
        return value

    def tables(self, table: dict[str, Any], key: str, key_path: KeyPath) -> list[dict[str, Any]]:
        """Return the tables of a name, as ``[[job]]`` are; an empty list if it has another type."""
        found = table.get(key, [])
        if not isinstance(found, list) or not all(isinstance(one, dict) for one in found):
            names = ".".join(str(part) for part in (*key_path, key) if isinstance(part, str))
            self.add((*key_path, key), f"Write {key} as an array of tables: [[{names}]].")
            return []
        return found
