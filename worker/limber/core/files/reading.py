"""Checked reading of files of other programs and of branch folders: JSON, TOML, arrays.

Such files may be truncated, corrupt or malicious. Therefore numbers must be finite and at most
``LARGEST_NUMBER``, declared sizes are compared with the file's size before memory is allocated,
nothing is unpickled, and every fault is an :class:`~limber.core.errors.InputError` that names the
file.
"""

import contextlib
import json
import math
import os
import re
import struct
import tokenize
import tomllib
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO, Any, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError

from limber.core.errors import InputError
from limber.core.files.atomic import require_no_pipe
from limber.core.json_values import LARGEST_NUMBER, first_refusal, validated

Content = TypeVar("Content")

LARGEST_EXPANSION = 100.0
"""Ratio of array bytes to compressed bytes above which ``HARMLESS_BYTES`` is the limit. Real
measurements compress tenfold at best.
"""
HARMLESS_BYTES = 256e6
_MOST_DIGITS = 40
"""Of an integer: a seed has up to 39."""
MOST_TOML_BYTES = 2 << 20
"""Largest hand-written TOML file; its parser takes two seconds per megabyte of tables."""
_MOST_KEY_PARTS = 32
_LONG_KEY = re.compile(r"""(?<![\w.-])(?:(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+)"""
                       f"{{{_MOST_KEY_PARTS}}}")
"""A dotted key with too many parts; the parser's time and memory grow with their number squared."""


class FileContent(BaseModel):
    """The part of a file's content that is read. Other entries are ignored."""

    model_config = ConfigDict(extra="allow", allow_inf_nan=False)


def read_text(path: str | os.PathLike, what: str, most_bytes: int = 512 << 20) -> str:
    """Return a file's text (UTF-8, with or without a BOM); ``what`` names it in errors. InputError
    if it cannot be read, is not text, or has more than ``most_bytes``."""
    require_no_pipe(path)
    with contextlib.suppress(OSError, ValueError):
        size = os.stat(path).st_size
        if size > most_bytes:
            raise InputError(f"{path} has {size / 1e6:.0f} MB.",
                             f"{what[0].upper()}{what[1:]} was expected; it has at most "
                             f"{most_bytes / 1e6:.0f} MB.", "Check that this is the right file.")
    try:
        text = Path(path).read_text(encoding="utf-8-sig")
        if "\0" in text:
            raise ValueError("it has zero bytes")
    except (OSError, ValueError) as error:
        raise unreadable(path, what, error) from error
    return text


def read_json(path: str | os.PathLike, what: str) -> Any:
    """Return the content of a JSON file; InputError if it is not JSON, or has half a character; or
    if a number is not finite, or beyond ``LARGEST_NUMBER``."""
    return json_content(read_text(path, what), path, what)


def json_content(text: str, path: str | os.PathLike, what: str) -> Any:
    """Return the content of a JSON text read from ``path``; InputError as :func:`read_json`."""
    try:
        content = json.loads(text, parse_constant=_finite, parse_float=_finite, parse_int=_integer)
        if re.search(r"\\u[dD]", text):
            # Half of a character, which no file could hold: a ValueError.
            json.dumps(content, ensure_ascii=False).encode()
        return content
    except (ValueError, RecursionError) as error:
        raise unreadable(path, what, error) from error


def read_json_as(path: str | os.PathLike, kind: type[Content], what: str) -> Content:
    """Return the content of a JSON file as ``kind``, any type that pydantic checks; InputError,
    with the position, if it is not JSON, or not of that kind."""
    return checked_as(path, kind, read_json(path, what), what)


def checked_as(path: str | os.PathLike, kind: type[Content], content: Any, what: str, *,
               strict: bool = False) -> Content:
    """Return content read from ``path`` as ``kind``; ``strict``, for content used unconverted: a
    number must be one in the file, not a text (a Boolean is never one). InputError, with the
    position, if it is not of that kind."""
    try:
        # Only pydantic's strict JSON mode accepts a list for a tuple.
        return (TypeAdapter(kind).validate_json(json.dumps(content), strict=True) if strict
                else validated(kind, content))
    except ValidationError as error:
        raise InputError(f"{path}: {first_refusal(error)}.",
                         f"{what[0].upper()}{what[1:]} was expected.",
                         "It is damaged, or was written by another program. Make it again.",
                         ) from error


def read_toml(path: str | os.PathLike, what: str, *, finite: bool = True) -> dict[str, Any]:
    """Return the content of a TOML file; InputError if it is not TOML (with the line), or a number
    is not finite, unless not ``finite``: the caller refuses such values itself, by name and
    line."""
    return toml_content(read_text(path, what, MOST_TOML_BYTES), path, what, finite=finite)


def toml_content(text: str, path: str | os.PathLike, what: str, *, finite: bool = True,
                 ) -> dict[str, Any]:
    """Return the content of a TOML text read from ``path``; InputError as :func:`read_toml`, or if
    a key is nested too deeply."""
    try:
        if len(text) > MOST_TOML_BYTES:
            raise ValueError(f"it has {len(text)} characters")
        if (long := _LONG_KEY.search(text)) is not None:
            raise ValueError(f"line {text.count(chr(10), 0, long.start()) + 1}: a key has more "
                             f"than {_MOST_KEY_PARTS} parts")
        return tomllib.loads(text, parse_float=_finite if finite else float)
    except (ValueError, RecursionError) as error:
        raise unreadable(path, what, error) from error


def read_arrays(path: str | os.PathLike, what: str) -> dict[str, np.ndarray]:
    """Return the arrays of an NPZ file, or the one of an NPY file as ``arr_0``; InputError if it is
    damaged, contains objects, or declares more than it can hold."""
    require_no_pipe(path)
    try:
        with open(path, "rb") as stream:
            if stream.read(6) == np.lib.format.MAGIC_PREFIX:
                stream.seek(0)
                return {"arr_0": _array(stream, os.path.getsize(path))}
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
            size = os.path.getsize(path)
            _require_modest(sum(member.file_size for member in members), size)
            arrays = {}
            for member in members:
                with archive.open(member) as stream:
                    name = member.filename.removesuffix(".npy")
                    arrays[name] = _array(stream, member.file_size)
        return arrays
    except (OSError, ValueError, EOFError, SyntaxError, TypeError, OverflowError, RuntimeError,
            NotImplementedError, RecursionError, tokenize.TokenError, zipfile.BadZipFile,
            zlib.error) as error:
        raise unreadable(path, what, error) from error


def require_finite(path: str | os.PathLike, arrays: Mapping[str, np.ndarray], what: str) -> None:
    """Refuse arrays with numbers not finite, or beyond ``LARGEST_NUMBER``: an InputError names
    it."""
    for name, values in arrays.items():
        if not are_moderate(values):
            raise InputError(f"{path}: {name} has values that are not finite, or beyond "
                             f"{LARGEST_NUMBER:g}.", f"{what[0].upper()}{what[1:]} holds numbers.",
                             "It is damaged. Make it again.")


def require_shapes(path: str | os.PathLike, arrays: Mapping[str, np.ndarray],
                   shapes: Mapping[str, tuple[int | str, ...]], what: str,
                   flags: Sequence[str] = ()) -> None:
    """Refuse arrays that are missing, not finite numbers (those of ``flags`` may be Booleans), or
    of another shape, the same letter meaning the same length: an InputError names the first."""
    lengths: dict[int | str, int] = {}
    for name, shape in shapes.items():
        array = arrays.get(name)
        fits = array is not None and array.dtype.kind in (
            "iufb" if name in flags else "iuf") and (array.ndim == len(shape)) and all(
            length == (expected if isinstance(expected, int)
                       else lengths.setdefault(expected, length))
            for expected, length in zip(shape, array.shape, strict=True))
        if not fits:
            found = "is missing" if array is None else (
                f"has shape {list(array.shape)} and type {array.dtype}")
            raise InputError(f"{path}: {name} {found}.",
                             f"{what[0].upper()}{what[1:]} was expected, with numbers of shape "
                             f"[{', '.join(map(str, shape))}] in this array.",
                             "It is damaged, or was written by another program. Make it again.")
    require_finite(path, {name: arrays[name] for name in shapes}, what)


def require_size(path: str | os.PathLike, announced: float, held: float, what: str) -> None:
    """Refuse a file with fewer bytes, ``held``, than the number of ``what`` that its header
    declares takes at least, before memory is allocated: an InputError."""
    if announced > held:
        raise InputError(f"{path} announces {what}: at least {announced:.3g} bytes. It contains "
                         f"only {max(held, 0):.3g}.",
                         "It is cut short, or its header is damaged.", "Export it again.")


def _array(stream: IO[bytes], size: int) -> np.ndarray:
    """Read one array after comparing its header with the available bytes."""
    version = np.lib.format.read_magic(stream)
    reader = {(1, 0): np.lib.format.read_array_header_1_0,
              (2, 0): np.lib.format.read_array_header_2_0}.get(version)
    if reader is None:
        raise ValueError(f"array format {version} is not known")
    shape, is_fortran, kind = reader(stream)
    if kind.hasobject:
        raise ValueError("it holds Python objects, which are never loaded")
    count = math.prod(shape)
    if count * kind.itemsize > size or any(length < 0 for length in shape):
        raise ValueError(f"an array of shape {shape} is announced, but there are only {size} "
                         "bytes")
    content = stream.read(count * kind.itemsize)
    if len(content) != count * kind.itemsize:
        raise ValueError("it is cut short")
    array = np.frombuffer(content, kind, count)
    return array.reshape(shape, order="F" if is_fortran else "C").copy()


def _require_modest(expanded: float, size: float) -> None:
    if expanded > max(LARGEST_EXPANSION * size, HARMLESS_BYTES):
        raise ValueError(f"its {size} bytes would expand to {expanded:.3g} bytes")


def are_moderate(values: np.ndarray) -> bool:
    """Whether all numbers are finite and at most ``LARGEST_NUMBER``."""
    return values.dtype.kind not in "fc" or bool((np.abs(values) <= LARGEST_NUMBER).all())


def _finite(text: str) -> float:
    number = float(text)
    if not abs(number) <= LARGEST_NUMBER:
        raise ValueError(f"{text} is not a finite number" if not math.isfinite(number) else
                         f"{text} is beyond {LARGEST_NUMBER:g}")
    return number


def _integer(text: str) -> int:
    if len(text) > _MOST_DIGITS:
        raise ValueError(f"it contains a number of {len(text)} digits")
    return int(text)


def unreadable(path: str | os.PathLike, what: str, error: Exception) -> InputError:
    reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    return InputError(f"{path} cannot be read ({reason[:300] or type(error).__name__}).",
                      f"{what[0].upper()}{what[1:]} was expected.",
                      "It is missing, damaged or of another type.")


# Comparison of a cloud file's declared size with its actual one, before it is read.
#
# The packages that read PLY, PCD and LAS allocate memory for the points that a header declares; a
# corrupt header may declare billions.

_PLY_BYTES = {"char": 1, "uchar": 1, "int8": 1, "uint8": 1, "short": 2, "ushort": 2, "int16": 2,
              "uint16": 2, "int": 4, "uint": 4, "int32": 4, "uint32": 4, "float": 4, "float32": 4,
              "double": 8, "float64": 8}
_LONGEST_HEADER = 1 << 20
_LZF_EXPANSION = 90.0
"""A byte of LZF expands to at most 264 / 3 bytes."""
_LAZ_EXPANSION = 1000.0


def check_ply(path: Path) -> None:
    """Refuse a PLY file that holds fewer elements than its header declares: an InputError."""
    lines, body = _text_header(path, b"end_header")
    is_text, announced, count, width = False, 0.0, 0, 0
    for words in [line.split() for line in lines] + [["element", "", "0"]]:
        if words[:1] == ["format"]:
            is_text = words[1:2] == ["ascii"]
        elif words[:1] == ["element"]:
            announced += count * width
            count, width = _count(path, words[2] if len(words) > 2 else ""), 0
        elif words[:1] == ["property"] and len(words) > 2:
            kind = words[2] if words[1] == "list" else words[1]
            # As text a value takes at least one digit and a separator.
            width += 2 if is_text else _PLY_BYTES.get(kind, 1)
    held = path.stat().st_size - body
    # The last value of a text needs no separator.
    require_size(path, announced, held + is_text, "its elements")


def check_pcd(path: Path) -> None:
    """Refuse a PCD file that holds fewer points than its header declares: an InputError."""
    lines, body = _text_header(path, b"\nDATA")
    header = {words[0]: words[1:] for line in lines if (words := line.split())}
    count = max(_count(path, word) for word in
                (header.get("POINTS") or ["0"])[:1] + (header.get("WIDTH") or ["0"])[:1])
    if header.get("WIDTH") and header.get("HEIGHT"):
        count = max(count, _count(path, header["WIDTH"][0]) * _count(path, header["HEIGHT"][0]))
    sizes = [_count(path, word) for word in header.get("SIZE", [])]
    repeats = [_count(path, word) for word in header.get("COUNT", [])] or [1] * len(sizes)
    kind = (header.get("DATA") or [""])[0]
    held = float(path.stat().st_size - body)
    if kind == "ascii":
        require_size(path, 2.0 * count * sum(repeats), held + 1, f"{count} points")
        return
    width = sum(size * repeat for size, repeat in zip(sizes, repeats, strict=False))
    if kind == "binary_compressed":
        with open(path, "rb") as stream:
            stream.seek(body)
            head = stream.read(8)
        packed, whole = struct.unpack("<II", head) if len(head) == 8 else (0, 0)
        require_size(path, packed, held - 8, "compressed points")
        require_size(path, whole, _LZF_EXPANSION * held, "compressed points")
        held = float(whole)
    require_size(path, float(count * width), held, f"{count} points")


def check_las(path: Path) -> None:
    """Refuse a LAS or LAZ file that is none, or holds fewer points than its header declares: an
    InputError."""
    size = path.stat().st_size
    with open(path, "rb") as stream:
        head = stream.read(375)
    if len(head) < 227 or head[:4] != b"LASF":
        raise InputError(f"{path} is not a LAS file.", "It does not begin with the LAS signature.",
                         "Export it again.")
    minor = head[25]
    start, record_count = struct.unpack_from("<II", head, 96)
    form, width, count = struct.unpack_from("<BHI", head, 104)
    if minor >= 4 and len(head) >= 255:
        extended_start, extended = struct.unpack_from("<QI", head, 235)
        count = max(count, struct.unpack_from("<Q", head, 247)[0])
        require_size(path, 60.0 * extended, max(size - extended_start, 0), "extended records")
    require_size(path, start, size, "an offset to its points")
    require_size(path, 54.0 * record_count, start, "its variable records")
    is_packed = bool(form & 0xC0)
    held = (size - start) * (_LAZ_EXPANSION if is_packed else 1.0)
    require_size(path, float(count) * max(width, 1), held, f"{count} points")
    if is_packed and count * width > HARMLESS_BYTES:
        require_size(path, float(count) * width, 100.0 * (size - start), f"{count} points")


def _text_header(path: Path, end: bytes) -> tuple[list[str], int]:
    """Return the lines of a header up to the line of ``end``, and its end position."""
    head, stop = header_bytes(path, end)
    return re.split(r"[\r\n]+", head.decode("latin-1").rstrip("\r\n")), stop


def header_bytes(path: Path, end: bytes) -> tuple[bytes, int]:
    """Return a header up to and including the line of ``end``, and its end position; InputError
    without such a line."""
    with open(path, "rb") as stream:
        head = stream.read(_LONGEST_HEADER)
    at = head.find(end)
    stop = head.find(b"\n", at + 1) if at >= 0 else -1
    if stop < 0:
        raise InputError(f"{path} has no header.",
                         "It is cut short, or its suffix does not match its content.",
                         "Export it again.")
    return head[:stop + 1], stop + 1


def _count(path: str | os.PathLike, word: str) -> int:
    if not re.fullmatch(r"\d{1,18}", word):
        raise InputError(f"{path} has {word[:30]!r} where a count was expected.",
                         "Its header is damaged.", "Export it again.")
    return int(word)
