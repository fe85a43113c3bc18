"""Registries of file formats: code that needs the known formats asks one of them.

A format is an entry of a registry. Other packages add theirs by a call::

    from limber.geometry.io.clouds import CLOUDS
    from limber.geometry.io.formats import Format
    CLOUDS.register(Format("FOO", (".foo",), read_foo))

or by an entry point of the registry's group whose value is a :class:`Format`; it is loaded when the
registry is first asked. The help of a command lists the formats that there are when it is loaded.
"""

import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Generic, TypeVar

from limber.core.errors import InputError, LimberError, MissingDependencyError
from limber.core.files.atomic import require_no_pipe
from limber.core.files.text_columns import ColumnsError
from limber.core.machine_errors import machine_error
from limber.core.optional import loaded
from limber.geometry.io.isolated_readers import read_apart

Function = Callable[..., Any] | str
"""A function, or ``module:name`` of one, which is imported when it is called."""


@dataclass(frozen=True)
class Format:
    """One file format.

    Attributes:
        name: Its common name.
        suffixes: Suffixes of its files, in lower case with the dot.
        read: Called with the path and the registry's options; returns the registry's type, or
            arrays that its ``of_arrays`` converts to it. None: it is only written.
        write: Called with the object and the path. None: it is only read.
        recognises: Whether a path has this format by its content: asked where the suffix belongs to
            no format, or to several.
        check: Refuses a file whose header announces more than the file holds.
        isolated: Whether ``read``, a function of a module, is called in a separate process with
            only the path, and returns arrays: compiled code may abort on a corrupt file.
        about: Text about it in the help, beside its suffixes.
    """

    name: str
    suffixes: tuple[str, ...] = ()
    read: Function | None = None
    write: Function | None = None
    recognises: Function | None = None
    check: Callable[[Path], None] | None = None
    isolated: bool | Callable[[Path], bool] = False
    about: str = ""


Kind = TypeVar("Kind", bound=Format)


@dataclass
class Registry(Generic[Kind]):
    """The formats of one kind of content.

    Attributes:
        what: Content of its files, for messages.
        group: The entry points of other packages.
        formats: The registered formats; later ones are asked first.
        of_arrays: Called with the path, the arrays that a format read, and the options.
    """

    what: str
    group: str
    formats: list[Kind] = field(default_factory=list)
    of_arrays: Function | None = None
    _is_complete: bool = False

    def register(self, added: Kind) -> None:
        """Add a format; ValueError if there is one of that name."""
        if any(one.name == added.name for one in self.formats):
            raise ValueError(f"A format {added.name!r} of a {self.what} already exists.")
        self.formats.insert(0, added)

    def __iter__(self) -> Iterator[Kind]:
        """All formats, those of other packages first."""
        if not self._is_complete:
            self._is_complete = True
            for entry in entry_points(group=self.group):
                try:
                    self.register(entry.load())
                except Exception as error:  # one format's failure must not stop the others
                    warnings.warn(f"The package of {entry.value} could not register a format of a "
                                  f"{self.what} ({type(error).__name__}: {error}).", stacklevel=2)
        return iter(tuple(self.formats))

    def of(self, path: Path) -> Kind:
        """Return the format of a file; see :func:`known_format`."""
        return known_format(path, self.what, self.readers())

    def read(self, path: Path, **options: Any) -> Any:
        """Return the content of a file; raises as :meth:`of` and :meth:`read_as`."""
        return self.read_as(self.of(path), path, **options)

    def read_as(self, chosen: Format, path: Path, **options: Any) -> Any:
        """Return the content of a file of this format.

        Raises:
            InputError: the file cannot be read. MissingDependencyError: it needs a package that is
                not installed.
        """
        try:
            return self._read(chosen, path, options)
        except (LimberError, MemoryError):
            raise
        except ColumnsError as error:
            raise InputError(error.seen, error.why, error.fix) from error
        except ImportError as error:
            raise MissingDependencyError(f"Reading {path.suffix} files requires the package "
                                         f"{error.name}.", "It is not installed.",
                                         f"Install it, or export the {self.what} in another "
                                         "format.") from error
        except Exception as error:  # each format's package raises its own
            kind = "" if type(error) is ValueError else f"{type(error).__name__}: "
            raise machine_error(error, path) or InputError(
                f"{path} cannot be read ({kind}{error}).",
                "The file is damaged, truncated, or does not have the format of its suffix.",
                "Export it again.") from error

    def write_as(self, chosen: Format, content: Any, path: Path, *further: Any) -> Any:
        """Write ``content`` to a file in this format."""
        return loaded(chosen.write)(content, path, *further)

    def _read(self, chosen: Format, path: Path, options: dict[str, Any]) -> Any:
        if chosen.check is not None:
            chosen.check(path)
        isolated = chosen.isolated(path) if callable(chosen.isolated) else chosen.isolated
        read = loaded(chosen.read)
        found = read_apart(read, path) if isolated else read(path, **options)
        return loaded(self.of_arrays)(path, found, **options) if isinstance(found, dict) else found

    def readers(self) -> list[Kind]:
        """Return the formats that can be read."""
        return [one for one in self if one.read is not None]

    def writers(self) -> list[Kind]:
        """Return the formats that can be written."""
        return [one for one in self if one.write is not None]


def known_format(path: Path, what: str, formats: Sequence[Kind]) -> Kind:
    """Return the format of a path that should hold ``what``. The suffix decides, then the content.
    Of several, one that does not check the content takes what no other recognises. InputError if
    none is known, or the path is a pipe or a device."""
    require_no_pipe(path)
    named = [one for one in formats if path.suffix.lower() in one.suffixes]
    plain = [one for one in named if one.recognises is None or len(named) == 1]
    if len(named) != 1 and path.exists():
        for one in named if plain else (*named, *formats):
            if one.recognises is not None and loaded(one.recognises)(path):
                return one
    if not plain:
        raise unknown_suffix(path, formats, f"Export the {what} in one of these formats.")
    return plain[0]


def unknown_suffix(path: Path, formats: Iterable[Format], fix: str) -> InputError:
    """Return the error for a file whose suffix belongs to none of these formats."""
    return InputError(f"{path.name} has an unknown suffix.",
                      f"Known suffixes are {' '.join(suffixes_of(formats))}.", fix)


def suffixes_of(formats: Iterable[Format]) -> tuple[str, ...]:
    """Return the suffixes of formats, sorted."""
    return tuple(sorted({suffix for one in formats for suffix in one.suffixes}))


def listed(formats: Iterable[Format]) -> str:
    """Return the suffixes of formats and their meaning, as a text for users."""
    endings: dict[str, list[str]] = {}
    for one in formats:
        endings.setdefault(" ".join(one.suffixes), []).extend([one.about] if one.about else [])
    return "; ".join(f"{suffixes} ({', '.join(abouts)})" if suffixes and abouts
                     else suffixes or ", ".join(abouts) for suffixes, abouts in endings.items())


def head_of(path: Path, count: int) -> bytes:
    """Return the first bytes of a file; empty for a folder."""
    if path.is_dir():
        return b""
    with open(path, "rb") as stream:
        return stream.read(count)


def starts_with(*marks: bytes) -> Callable[[Path], bool]:
    """Return a function that recognises files that begin with one of ``marks``."""
    def recognises(path: Path) -> bool:
        return head_of(path, max(map(len, marks))).startswith(marks)
    return recognises
