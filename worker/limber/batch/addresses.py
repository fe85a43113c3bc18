"""Addresses of files that are elsewhere (``s3://``, ``sftp://``, ``gs://`` ...), by fsspec.

Neither locks nor renames can be relied on there: files are brought here, and results are put
there. Who may read and write is fsspec's business (its configuration and environment), never the
job file's.
"""

import hashlib
import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any

from filelock import FileLock

from limber.core.errors import InputError, LimberError, MissingDependencyError, WorkError
from limber.core.files.atomic import write_atomically
from limber.core.files.temporary_names import owned_name, sweep_beside
from limber.core.optional import require_extra
from limber.store.disk import LEAST_FREE_BYTES

# One letter before the colon is a drive.
_ADDRESS = re.compile(r"^([A-Za-z][A-Za-z0-9+.-]+)://(.*)$", re.DOTALL)
_BLOCK = 1 << 22
_PLAIN_NAME = re.compile(r"^[^./\\:*?\"<>|\x00-\x1f][^/\\:*?\"<>|\x00-\x1f]*$")
_TELLING = frozenset(
    "etag checksum md5hash content_md5 sha generation versionid mtime modify modified lastmodified "
    "last_modified updated created time".split())
"""In what file systems say of a file, in small letters: what changes with its content."""
_MOST_BYTES_READ = 64 << 20


def is_address(text: str) -> bool:
    """Whether a text is an address and no path."""
    return _ADDRESS.match(text) is not None


def checked_address(address: str) -> str:
    """Return an address without a slash at its end.

    Raises:
        InputError: it is chained, holds a password, or leads upwards.
    """
    # First of all: the other messages show the address.
    for part in address.split("::"):
        host = part.partition("://")[2].partition("/")[0]
        if ":" in host.rpartition("@")[0]:
            raise InputError(f"The address at {host.rpartition('@')[2]} has a password in it.",
                             "Job files, tables and logs would show it.",
                             "Put it into fsspec's configuration (~/.config/fsspec) or "
                             "environment.")
    if "::" in address:
        raise InputError(f"{address!r} is a chain of addresses.",
                         "Each file is fetched from one place.", "Name that place alone.")
    _, _, rest = address.partition("://")
    if ".." in PurePosixPath(rest).parts:
        raise InputError(f"{address!r} leads upwards.", "", "Write where it leads to.")
    return address.rstrip("/")


def plain_name(address: str) -> str:
    """Return the last part of an address, as the name that the file gets here.

    Raises:
        InputError: it is no name that every system takes.
    """
    name = address.rstrip("/").rpartition("/")[2]
    if not _PLAIN_NAME.match(name):
        raise InputError(f"{address!r} ends with {name!r}, which is no name of a file here.",
                         "It begins with a dot or has one of \\ / : * ? \" < > | in it.",
                         "Rename it.")
    return name


def matching(pattern: str) -> list[str]:
    """Return the addresses that a pattern, or an address, stands for, sorted.

    Raises:
        InputError: it is refused. WorkError: its place cannot be read.
    """
    address = checked_address(pattern)
    system, path = _system(address)
    before = _before(system, address, path)
    with _explained(pattern, "listed"):
        system.invalidate_cache()
        return sorted(f"{before}{found}".rstrip("/") for found in system.glob(path))


def fetch(address: str, target: Path, stop: Callable[[], None]) -> None:
    """Bring a file, or a folder, to ``target``, unless it is there as it is at its address.

    It is there whole or not at all.

    Args:
        stop: Called now and then; raises to end it.

    Raises:
        WorkError: it is not there, was cut short, or finds no room here.
    """
    system, path = _system(address)
    with _explained(address, "read"):
        system.invalidate_cache()
        about = system.info(path)
        is_folder = about["type"] == "directory"
        found = system.find(path, detail=True) if is_folder else {path: about}
    before = _before(system, address, path)
    target.parent.mkdir(parents=True, exist_ok=True)
    # Several branches may need it.
    with FileLock(target.with_name(f".{target.name}.lock")):
        mark, told = target.with_name(f".{target.name}.fetched"), _told(found)
        if told and target.exists() and mark.is_file() and mark.read_text("utf-8") == told:
            return
        _require_room(target.parent, address, sum(one.get("size") or 0 for one in found.values()))
        sweep_beside(target)
        mark.unlink(missing_ok=True)
        made = target.with_name(owned_name(target.name))
        try:
            for place, one in found.items():
                inner = made / _inside(path, place) if is_folder else made
                inner.parent.mkdir(parents=True, exist_ok=True)
                with _explained(f"{before}{place}", "read"):
                    _copy(system, place, inner, one.get("size"), stop)
            if is_folder:
                remove(target)
            made.replace(target)
        finally:
            remove(made)
        write_atomically(mark, told)


def copy_here(address: str, target: Path, stop: Callable[[], None]) -> None:
    """Copy one file to where nothing is yet; as :func:`fetch`, but cut off it may be a part."""
    system, path = _system(address)
    with _explained(address, "read"):
        size = system.info(path).get("size")
        target.parent.mkdir(parents=True, exist_ok=True)
        _require_room(target.parent, address, size or 0)
        _copy(system, path, target, size, stop)


def put(source: Path, address: str) -> None:
    """Put a file at an address.

    Raises:
        WorkError: it cannot be written there.
    """
    system, path = _system(address)
    with _explained(address, "written"):
        try:
            system.put_file(str(source), path)
        except FileNotFoundError:
            # Disks have folders, which have to be made; other places mostly have none.
            system.makedirs(path.rpartition("/")[0], exist_ok=True)
            system.put_file(str(source), path)


def read_bytes(address: str) -> bytes | None:
    """Return what a small file at an address holds; None where there is none.

    Raises:
        WorkError: its place cannot be read, or it is large.
    """
    system, path = _system(address)
    with _explained(address, "read"):
        system.invalidate_cache()
        try:
            if (system.info(path).get("size") or 0) > _MOST_BYTES_READ:
                raise WorkError(f"{address} is over {_MOST_BYTES_READ >> 20} MiB.",
                                "A manifest was expected.", "Check the address.")
            return bytes(system.cat_file(path))
        except FileNotFoundError:
            return None


def take_away(address: str) -> None:
    """Remove a file at an address, if it is there."""
    system, path = _system(address)
    with _explained(address, "removed"):
        try:
            system.rm_file(path)
        except FileNotFoundError:
            return


def remove(path: Path) -> None:
    """Remove a file or folder here, if it is there."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def _system(address: str) -> tuple[Any, str]:
    """Return the file system of an address, and the path in it."""
    require_extra("remote", ("fsspec",), f"The address {address}")
    from fsspec.core import url_to_fs

    try:
        return url_to_fs(address)
    except ImportError as error:
        raise MissingDependencyError(
            f"{address} needs a package that is not installed.", f"{error}.",
            "Install it beside Limber; fsspec names one for each kind of address.") from error
    except Exception as error:  # each file system raises its own
        raise InputError(f"{address} is no address that can be used "
                         f"({type(error).__name__}: {error}).", "",
                         "fsspec's documentation lists the kinds there are.") from error


def _before(system: Any, address: str, path: str) -> str:
    """What stands in an address before its path: SFTP and its like leave the host out of paths."""
    if address.endswith(path):
        return address.removesuffix(path)
    return system.unstrip_protocol(path).removesuffix(path)


@contextmanager
def _explained(address: str, what: str) -> Iterator[None]:
    """Say where something went wrong that a file system's client raised in its own way."""
    try:
        yield
    except LimberError:
        raise
    except FileNotFoundError as error:
        raise WorkError(f"There is no {address}.", "", "Check the address.") from error
    except Exception as error:  # each file system's client raises its own
        raise WorkError(f"{address} could not be {what} ({type(error).__name__}: {error}).",
                        "Its place does not answer, or you may not.",
                        "Check network and credentials, and run this with --retry-failed.",
                        ) from error


def _told(found: dict[str, dict[str, Any]]) -> str:
    """What tells whether files have changed; nothing where their system does not say."""
    if not all(any(value and str(key).lower() in _TELLING for key, value in one.items())
               for one in found.values()):
        return ""
    told = sorted((place, sorted(map(repr, one.items()))) for place, one in found.items())
    return hashlib.sha256(repr(told).encode()).hexdigest()


def _inside(folder: str, place: str) -> PurePosixPath:
    """The place of a file in its folder.

    Raises:
        InputError: a part of it is no plain name.
    """
    inner = PurePosixPath(place).relative_to(PurePosixPath(folder))
    for part in inner.parts:
        plain_name(part)
    return inner


def _require_room(folder: Path, address: str, size: float) -> None:
    free = shutil.disk_usage(folder).free
    if free < size + LEAST_FREE_BYTES:
        raise WorkError(f"The disk of {folder} has {free / 1e6:.0f} MB left, and {address} has "
                        f"{size / 1e6:.0f}.", "It is brought here before it is used.",
                        "Make room, or name another disk (`work` in the job file).")


def _copy(system: Any, place: str, target: Path, size: int | None,
          stop: Callable[[], None]) -> None:
    count = 0
    with system.open(place, "rb") as source, open(target, "xb") as sink:
        while block := source.read(_BLOCK):
            stop()
            count += len(block)
            sink.write(block)
            if size is not None and count > size:
                break
    if size is not None and count != size:
        raise WorkError(f"{place} was to have {size} bytes, and {count} came.",
                        "It was cut short, or written meanwhile.", "Run this again.")
