"""Files changed at random, as damage and malice do: bytes, lines, numbers, JSON, arrays."""

import io
import json
import tokenize
import zipfile
import zlib
from collections.abc import Callable
from typing import Any

import numpy as np

_NASTY_TEXT = ("nan", "inf", "-inf", "1e400", "-1", "0", "1e30", "99999999999", "4294967295", "",
               "true", "[]", "{}", "null", "x", "../../x", "1e-300", "<b>", "\0", "0 0 0")
_NASTY_JSON = (None, True, -1, 0, 1e308, -1e308, 10**30, "", "x", "../../etc", [], {}, [[]],
               [None], ["x"], {"x": 1}, "1e400", "NaN", 0.5)
_NASTY_BYTES = (b"\0", b"\xff", b"\x7f", b"\xff" * 4, b"\0" * 4, b"\xff\xff\xff\x7f", b"\xff" * 8,
                b"\0" * 8, b"\0\0\0\0\0\0\xf0\x7f", b"\x40\x42\x0f\0", b"\0\xca\x9a\x3b")


def mutated(content: bytes, kind: str, rng: np.random.Generator) -> bytes:
    """Return changed content of a file that is ``text``, ``json``, ``npz`` or ``binary``."""
    ways: dict[str, list[Callable[[bytes, np.random.Generator], bytes]]] = {
        "text": [_numbers_replaced, _numbers_replaced, _lines_changed, _bytes_changed],
        "json": [_value_replaced, _value_replaced, _value_replaced, _numbers_replaced,
                 _bytes_changed],
        "npz": [_array_changed, _array_changed, _array_changed, _bytes_changed],
        "binary": [_bytes_changed]}
    for _ in range(1 if rng.random() < 0.7 else int(rng.integers(2, 5))):
        found = ways[kind]
        content = found[rng.integers(len(found))](content, rng)
    return content


def _bytes_changed(content: bytes, rng: np.random.Generator) -> bytes:
    if not content:
        return b"\0"
    # Headers are short, and what stands there does the most harm.
    near = int(rng.integers(min(len(content), 400))) if rng.random() < 0.6 else int(
        rng.integers(len(content)))
    way = rng.integers(5)
    if way == 0:
        return content[:int(rng.integers(len(content)))]
    if way == 1:
        nasty = _NASTY_BYTES[rng.integers(len(_NASTY_BYTES))]
        return content[:near] + nasty + content[near + len(nasty):]
    if way == 2:
        changed = bytearray(content)
        for at in {near, *rng.integers(len(content), size=3).tolist()}:
            changed[at] ^= 1 << int(rng.integers(8))
        return bytes(changed)
    end = near + int(rng.integers(1, 64))
    if way == 3:
        return content[:near] + content[end:]
    return content[:end] + content[near:end] * int(rng.integers(1, 40)) + content[end:]


def _numbers_replaced(content: bytes, rng: np.random.Generator) -> bytes:
    import re

    text = content.decode("latin-1")
    found = list(re.finditer(r"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?", text))
    if not found:
        return _bytes_changed(content, rng)
    one = found[int(rng.integers(min(len(found), 40)))] if rng.random() < 0.5 else found[
        int(rng.integers(len(found)))]
    nasty = _NASTY_TEXT[rng.integers(len(_NASTY_TEXT))]
    return (text[:one.start()] + nasty + text[one.end():]).encode("latin-1")


def _lines_changed(content: bytes, rng: np.random.Generator) -> bytes:
    lines = content.split(b"\n")
    at, other = (int(rng.integers(len(lines))) for _ in range(2))
    way = rng.integers(5)
    if way == 0:
        del lines[at]
    elif way == 1:
        lines[at], lines[other] = lines[other], lines[at]
    elif way == 2:
        lines.insert(at, lines[other])
    elif way == 3:
        words = lines[at].split()
        lines[at] = b" ".join(words[:int(rng.integers(len(words) + 1))])
    else:
        lines[at] = lines[at] + b" " + lines[other] * int(rng.integers(1, 5))
    return b"\n".join(lines)


def _value_replaced(content: bytes, rng: np.random.Generator) -> bytes:
    try:
        tree = json.loads(content)
    except ValueError:
        return _bytes_changed(content, rng)
    places = list(_places(tree))
    if not places:
        return json.dumps(_NASTY_JSON[rng.integers(len(_NASTY_JSON))]).encode()
    # By depth first: else the long lists of numbers would get nearly all of the changes.
    depths = sorted({depth for depth, _, _ in places})
    wanted = depths[int(rng.integers(len(depths)))]
    among = [place for place in places if place[0] == wanted]
    _, holder, key = among[int(rng.integers(len(among)))]
    if rng.random() < 0.25:
        del holder[key]
    elif rng.random() < 0.1:
        holder[key] = [holder[key]]
    else:
        holder[key] = _NASTY_JSON[rng.integers(len(_NASTY_JSON))]
    return json.dumps(tree).encode()


def _places(tree: Any, depth: int = 0) -> Any:
    keys = tree.keys() if isinstance(tree, dict) else (
        range(len(tree)) if isinstance(tree, list) else ())
    for key in list(keys):
        yield depth, tree, key
        yield from _places(tree[key], depth + 1)


def _array_changed(content: bytes, rng: np.random.Generator) -> bytes:
    try:
        with np.load(io.BytesIO(content)) as file:
            arrays = {name: file[name] for name in file.files}
    except (ValueError, OSError, EOFError, KeyError, TypeError, NotImplementedError, SyntaxError,
            tokenize.TokenError, zipfile.BadZipFile, zlib.error):
        return _bytes_changed(content, rng)
    name = list(arrays)[int(rng.integers(len(arrays)))]
    array = arrays[name]
    way = rng.integers(8)
    if way == 0:
        del arrays[name]
    elif way == 1:
        arrays[name] = array.ravel()
    elif way == 2:
        arrays[name] = array[:0] if array.ndim else np.zeros(0)
    elif way == 3:
        arrays[name] = array.astype("U8") if array.dtype.kind != "U" else np.array(3)
    elif way == 4 and array.dtype.kind == "f" and array.size:
        values = array.copy().reshape(-1)
        values[rng.integers(len(values))] = (np.nan, np.inf, 1e300, -1.0)[rng.integers(4)]
        arrays[name] = values.reshape(array.shape)
    elif way == 5:
        arrays[name] = np.array(None, object) if rng.random() < 0.3 else np.array(7)
    elif way == 6 and array.dtype.kind == "i" and array.size:
        values = array.copy().reshape(-1)
        values[rng.integers(len(values))] = (-1, 2**30, 10**6)[rng.integers(3)]
        arrays[name] = values.reshape(array.shape)
    else:
        arrays[name] = np.repeat(array, 2, axis=0) if array.ndim else array
    out = io.BytesIO()
    np.savez(out, **arrays)
    return out.getvalue()
