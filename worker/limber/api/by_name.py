"""Entries of a branch folder by name."""

from collections.abc import Callable, Iterator, Mapping
from typing import Generic, TypeVar

Value = TypeVar("Value")


class ByName(Mapping[str, Value], Generic[Value]):
    """Entries of a branch folder by name; each is read on request."""

    def __init__(self, names: list[str], read: Callable[[str], Value]):
        self._names, self._read = tuple(names), read

    def __getitem__(self, name: str) -> Value:
        if name not in self._names:
            raise KeyError(f"{name!r} does not exist; known: {', '.join(self._names) or 'none'}")
        return self._read(name)

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)

    def __repr__(self) -> str:
        return f"<{', '.join(self._names) or 'none'}>"
