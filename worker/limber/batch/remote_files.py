"""Addresses of remote files (``s3://``, ``sftp://``, ``gs://`` ...), by fsspec.

Locks and renames are not reliable there: files are fetched to this computer, and results are
uploaded. Read and write permissions are managed by fsspec (its configuration and environment),
never by the job file.
"""

import hashlib
import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any

from filelock import FileLock

from limber.core.errors import InputError, LimberError, MissingDependencyError, Option, WorkError
from limber.core.files.atomic import owned_name, sweep_beside, write_atomically
from limber.core.optional import require_extra
from limber.store.disk_errors import LEAST_FREE_BYTES

# One letter before the colon is a drive.
_ADDRESS = re.compile(r"^([A-Za-z][A-Za-z0-9+.-]+)://(.*)$", re.DOTALL)
_BLOCK = 1 << 22
_PLAIN_NAME = re.compile(r"^[^./\\:*?\"<>|\x00-\x1f][^/\\:*?\"<>|\x00-\x1f]*$")
_TELLING = frozenset(
    "etag checksum md5hash content_md5 sha generation versionid mtime modify modified lastmodified "
    "last_modified updated created time".split())
"""The entries of a file system's information that change with a file's content, in lower case."""
_MOST_BYTES_READ = 64 << 20


def is_address(text: str) -> bool:
    """Whether a text is an address, not a path."""
    return _ADDRESS.match(text) is not None


def checked_address(address: str) -> str:
    """Return an address without a slash at its end; InputError if it is chained, or contains a
    password or ``..``."""
    # Checked first: the other messages show the address.
    for part in address.split("::"):
        host = part.partition("://")[2].partition("/")[0]
        if ":" in host.rpartition("@")[0]:
            raise InputError(f"The address at {host.rpartition('@')[2]} contains a password.",
                             "Job files, tables and logs would show it.",
                             "Store the password in fsspec's configuration (~/.config/fsspec) or "
                             "in the environment.")
    if "::" in address:
        raise InputError(f"{address!r} is a chain of addresses.",
                         "Each file is fetched from a single address.", "Give only that address.")
    _, _, rest = address.partition("://")
    if ".." in PurePosixPath(rest).parts:
        raise InputError(f"{address!r} contains `..`.", "", "Write the resulting address instead.")
    return address.rstrip("/")


def plain_name(address: str) -> str:
    """Return the last part of an address, the local file's name; InputError if not every system
    accepts it."""
    name = address.rstrip("/").rpartition("/")[2]
    if not _PLAIN_NAME.match(name):
        raise InputError(f"{address!r} ends with {name!r}, which is not a valid file name "
                         "on this computer.",
                         "The name is empty, begins with a dot or contains one of "
                         "\\ / : * ? \" < > |.",
                         "Rename the file.")
    return name


def matching(pattern: str) -> list[str]:
    """Return the addresses that match a pattern or an address, sorted. InputError if it is invalid;
    WorkError if the server cannot be read."""
    address = checked_address(pattern)
    system, path = _system(address)
    before = _before(system, address, path)
    with _explained(pattern, "listed"):
        system.invalidate_cache()
        return sorted(f"{before}{found}".rstrip("/") for found in system.glob(path))


def fetch(address: str, target: Path, stop: Callable[[], None]) -> None:
    """Copy a file or folder to ``target``, unless an unchanged copy is there; it is complete or
    does not exist. ``stop`` is called repeatedly and ends the copy by raising. WorkError if it does
    not exist, was interrupted, or exceeds the free space."""
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
        mark, digest = target.with_name(f".{target.name}.fetched"), _digest(found)
        if digest and target.exists() and mark.is_file() and mark.read_text("utf-8") == digest:
            return
        _require_room(target.parent, address, sum(one.get("size") or 0 for one in found.values()))
        sweep_beside(target)
        mark.unlink(missing_ok=True)
        made = target.with_name(owned_name(target.name))
        try:
            for name, one in found.items():
                inner = made / _inside(path, name) if is_folder else made
                inner.parent.mkdir(parents=True, exist_ok=True)
                with _explained(f"{before}{name}", "read"):
                    _copy(system, name, inner, one.get("size"), stop)
            if is_folder:
                remove(target)
            made.replace(target)
        finally:
            remove(made)
        write_atomically(mark, digest)


def copy_here(address: str, target: Path, stop: Callable[[], None]) -> None:
    """Copy one file to a free path, like :func:`fetch`; if interrupted, a part may be left."""
    system, path = _system(address)
    with _explained(address, "read"):
        size = system.info(path).get("size")
        target.parent.mkdir(parents=True, exist_ok=True)
        _require_room(target.parent, address, size or 0)
        _copy(system, path, target, size, stop)


def put(source: Path, address: str) -> None:
    """Put a file at an address; WorkError if it cannot be written there."""
    system, path = _system(address)
    with _explained(address, "written"):
        try:
            system.put_file(str(source), path)
        except FileNotFoundError:
            # Disks have folders, which must be created; most other storage has none.
            system.makedirs(path.rpartition("/")[0], exist_ok=True)
            system.put_file(str(source), path)


def read_bytes(address: str) -> bytes | None:
    """Return the content of a small file at an address, None if it does not exist; WorkError if the
    server cannot be read, or the file is large."""
    system, path = _system(address)
    with _explained(address, "read"):
        system.invalidate_cache()
        try:
            if (system.info(path).get("size") or 0) > _MOST_BYTES_READ:
                raise WorkError(f"{address} exceeds {_MOST_BYTES_READ >> 20} MiB.",
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
    """Remove a local file or folder, if it exists."""
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
            "Install that package as well. The documentation of fsspec names the package for each "
            "kind of address.") from error
    except Exception as error:  # each file system raises its own
        raise InputError(f"{address} is not a usable address ({type(error).__name__}: "
                         f"{error}).", "",
                         "The documentation of fsspec lists the supported kinds.") from error


def _before(system: Any, address: str, path: str) -> str:
    """The part of an address before its path: SFTP and others omit the host in paths."""
    if address.endswith(path):
        return address.removesuffix(path)
    return system.unstrip_protocol(path).removesuffix(path)


@contextmanager
def _explained(address: str, what: str) -> Iterator[None]:
    """Convert errors of a file system's client into ours, with the address."""
    try:
        yield
    except LimberError:
        raise
    except FileNotFoundError as error:
        raise WorkError(f"{address} does not exist.", "", "Check the address.") from error
    except Exception as error:  # each file system's client raises its own
        raise WorkError(f"{address} could not be {what} ({type(error).__name__}: {error}).", "The "
                        "server does not respond, or access is denied.", "Check the network and "
                        "the credentials, and run this with ", Option("retry_failed", True),
                        ".") from error


def _digest(found: dict[str, dict[str, Any]]) -> str:
    """A digest that changes with the files; empty if their system does not report changes."""
    if not all(any(value and str(key).lower() in _TELLING for key, value in one.items())
               for one in found.values()):
        return ""
    entries = sorted((path, sorted(map(repr, one.items()))) for path, one in found.items())
    return hashlib.sha256(repr(entries).encode()).hexdigest()


def _inside(folder: str, path: str) -> PurePosixPath:
    """The relative path of a file in its folder; InputError if a part of it is not a plain name."""
    inner = PurePosixPath(path).relative_to(PurePosixPath(folder))
    for part in inner.parts:
        plain_name(part)
    return inner


def _require_room(folder: Path, address: str, size: float) -> None:
    free = shutil.disk_usage(folder).free
    if free < size + LEAST_FREE_BYTES:
        raise WorkError(f"The disk of {folder} has {free / 1e6:.0f} MB left, and {address} needs "
                        f"{size / 1e6:.0f} MB.",
                        "The file is copied to this disk before it is used.",
                        "Make room, or name another disk (`work` in the job file).")


def _copy(system: Any, path: str, target: Path, size: int | None,
          stop: Callable[[], None]) -> None:
    count = 0
    with system.open(path, "rb") as source, open(target, "xb") as sink:
        while block := source.read(_BLOCK):
            stop()
            count += len(block)
            sink.write(block)
            if size is not None and count > size:
                break
    if size is not None and count != size:
        raise WorkError(f"{path} should have {size} bytes, but {count} were received.",
                        "The transfer was interrupted, or the file was written to at the same "
                        "time.", "Run this again.")
