"""Files changed at random, as by damage, malice and slips: bytes, lines, numbers, units, titles."""

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
_FACTORS = (1e3, 1e-3, 1e6, 1e-6, 1e9, 57.29577951, 0.0254, -1.0, 0.0, 1e30, 1e200, 1e-300)
"""From metres to millimetres, degrees, inches; from seconds to nanoseconds; and nonsense."""
_TITLES = ("x", "X [mm]", "Force (kN)", "time_ms", "t_us", "//X", "", '"x"', "Zeit", "index",
           "x_m", "nan", "a" * 300, "Fx [N]", "x,y")
_NASTY_JSON = (None, True, -1, 0, 1e308, -1e308, 10**30, "", "x", "../../etc", [], {}, [[]],
               [None], ["x"], {"x": 1}, "1e400", "NaN", 0.5)
_NASTY_BYTES = (b"\0", b"\xff", b"\x7f", b"\xff" * 4, b"\0" * 4, b"\xff\xff\xff\x7f", b"\xff" * 8,
                b"\0" * 8, b"\0\0\0\0\0\0\xf0\x7f", b"\x40\x42\x0f\0", b"\0\xca\x9a\x3b")


def mutated(content: bytes, kind: str, rng: np.random.Generator) -> bytes:
    """Return changed content of a file that is ``text``, ``json``, ``npz``, ``binary`` or a command
    line (``words``)."""
    ways: dict[str, list[Callable[[bytes, np.random.Generator], bytes]]] = {
        "text": [_numbers_replaced, _numbers_replaced, _lines_changed, _bytes_changed,
                 _column_scaled, _column_scaled, _title_changed],
        "json": [_value_replaced, _value_replaced, _value_replaced, _numbers_replaced,
                 _bytes_changed, _numbers_scaled],
        "npz": [_array_changed, _array_changed, _array_changed, _bytes_changed, _array_scaled],
        "binary": [_bytes_changed], "words": [_word_changed]}
    for _ in range(1 if rng.random() < 0.7 else int(rng.integers(2, 5))):
        found = ways[kind]
        content = found[rng.integers(len(found))](content, rng)
    return content


def _bytes_changed(content: bytes, rng: np.random.Generator) -> bytes:
    if not content:
        return b"\0"
    # Headers are short, and changes there do the most harm.
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


def _scaled(text: str, factor: float) -> str:
    try:
        return f"{float(text) * factor:.9g}"
    except ValueError:
        return text


def _column_scaled(content: bytes, rng: np.random.Generator) -> bytes:
    """One column in another unit, with the other sign, constant, or exchanged with another."""
    text = content.decode("latin-1")
    lines = text.split("\n")
    sign = max(",;\t ", key=lines[len(lines) // 2].count)
    width = lines[len(lines) // 2].count(sign) + 1
    at, other, way = (int(rng.integers(width)), int(rng.integers(width)), int(rng.integers(4)))
    factor = float(_FACTORS[rng.integers(len(_FACTORS))])
    for number, line in enumerate(lines):
        fields = line.split(sign)
        if len(fields) != width or (number == 0 and way != 3):
            continue
        if way == 3:
            fields[at], fields[other] = fields[other], fields[at]
        elif way == 2:
            fields[at] = "0"
        else:
            fields[at] = _scaled(fields[at], factor)
        lines[number] = sign.join(fields)
    return "\n".join(lines).encode("latin-1")


def _title_changed(content: bytes, rng: np.random.Generator) -> bytes:
    """A word of the first line is replaced by another title, or unit."""
    first, end, rest = content.partition(b"\n")
    words = [part for part in first.replace(b";", b",").split(b",") if part]
    if not words:
        return _lines_changed(content, rng)
    title = _TITLES[rng.integers(len(_TITLES))].encode()
    return first.replace(words[int(rng.integers(len(words)))], title, 1) + end + rest


def _numbers_scaled(content: bytes, rng: np.random.Generator) -> bytes:
    """All numbers of a JSON list, or one number, in another unit."""
    try:
        tree = json.loads(content)
    except ValueError:
        return _bytes_changed(content, rng)
    factor = float(_FACTORS[rng.integers(len(_FACTORS))])
    places = [(holder, key) for _, holder, key in _places(tree)
              if isinstance(holder[key], int | float) and not isinstance(holder[key], bool)]
    if not places:
        return content
    holder, chosen = places[int(rng.integers(len(places)))]
    for key in (range(len(holder)) if isinstance(holder, list) else [chosen]):
        if isinstance(holder[key], int | float):
            holder[key] = holder[key] * factor
    return json.dumps(tree).encode()


def _word_changed(content: bytes, rng: np.random.Generator) -> bytes:
    """A command line with another value, a word removed or repeated, or a further option."""
    from benchmarks.worker_command_lines import with_further_option

    try:
        line = json.loads(content)
        assert isinstance(line, list) and line
    except (ValueError, AssertionError):
        return content
    way = int(rng.integers(7))
    at = int(rng.integers(len(line)))
    if way == 0:
        del line[at]
    elif way == 1:
        line.insert(at, line[at])
    elif way >= 4:
        line = with_further_option(line, rng)
    values = [number for number, word in enumerate(line)
              if number > 1 and word[:2] not in ("--", "-o") and "{" not in word]
    if way >= 2 and values:
        at = values[int(rng.integers(len(values)))]
        line[at] = (_scaled(line[at], float(_FACTORS[rng.integers(len(_FACTORS))]))
                    if rng.random() < 0.5 else _NASTY_TEXT[rng.integers(len(_NASTY_TEXT))])
    return json.dumps([word.replace("\0", "\x01") for word in line]).encode()


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


def _arrays(content: bytes) -> dict[str, np.ndarray]:
    """Arrays of an NPZ file; empty if earlier mutations have left none that can be read."""
    try:
        with np.load(io.BytesIO(content)) as file:
            return {name: file[name] for name in file.files}
    except (ValueError, OSError, EOFError, KeyError, TypeError, NotImplementedError, SyntaxError,
            tokenize.TokenError, zipfile.BadZipFile, zlib.error):
        return {}


def _array_scaled(content: bytes, rng: np.random.Generator) -> bytes:
    """Numbers of an array in another unit, as dates, or complex."""
    arrays = _arrays(content)
    if not arrays:
        return _bytes_changed(content, rng)
    numbers = [name for name, array in arrays.items() if array.dtype.kind in "fiu"]
    if not numbers:
        return content
    name, way = numbers[int(rng.integers(len(numbers)))], int(rng.integers(6))
    kind = {0: complex, 1: "datetime64[s]", 2: bool}.get(way)
    with np.errstate(all="ignore"):
        arrays[name] = (arrays[name] * _FACTORS[rng.integers(len(_FACTORS))] if kind is None else
                        arrays[name].astype(np.int64).astype(kind))
    out = io.BytesIO()
    np.savez(out, **arrays)
    return out.getvalue()


def _array_changed(content: bytes, rng: np.random.Generator) -> bytes:
    arrays = _arrays(content)
    if not arrays:
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
        arrays[name] = array.astype(str) if array.dtype.kind != "U" else np.array(3)
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
