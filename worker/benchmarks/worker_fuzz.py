"""Mutated files given to every reader, in a process that may crash, hang or run out of memory.

``python -m benchmarks.worker_fuzz TEMPLATE`` is that process: each line of its input has a reader's
name and a file; it answers with one line of JSON. Command lines with options of any value are read
as well: a file is one as a JSON list; ``{branch}`` stands for a copy of the template, ``{out}`` for
an empty folder, ``{in}`` for a folder with inputs. The command must end with one of the documented
exit codes, and a message.
"""

import contextlib
import io
import json
import os
import re
import resource
import shutil
import subprocess
import sys
import tempfile
import threading
import time
import tokenize
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import cache, partial
from pathlib import Path
from queue import Empty, Queue
from typing import Any

import numpy as np

from benchmarks.table import Asked, Part, Row, Setting
from benchmarks.worker_branch_files import BRANCH_READERS, TEMPLATE, Reader
from benchmarks.worker_files import FILE_READERS
from limber.core.errors import InputError, LimberError
from limber.stages.registry import stage_schema, stage_summaries

# --- files changed at random, as by damage, malice and slips -----------------------------------

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


# --- command lines ------------------------------------------------------------------------------

_LINES: dict[str, list[list[str]]] = {
    "predict": [["predict", "{branch}", "--weight", "0.1"]],
    "import-pull": [
        ["import-pull", "{branch}", "{in}/markers.csv", "--name", "p", "--robot", "{in}/robot.csv",
         "--unit", "m", "--time-offset", "0"],
        ["import-pull", "{branch}", "{in}/robot.csv", "--name", "p"]],
    "mesh": [["mesh", "{in}/branch.swc", "-o", "{out}/a.branch", "--unit", "m"]],
    "skeleton": [["skeleton", "{branch}"]],
    "target": [["target", "{branch}", "fruit", "--at", "-0.056", "-0.033", "0.285", "--mass",
                "0.1"]],
    "vibration": [["vibration", "{branch}", "{in}/ring.csv"]],
    "export": [["export", "{branch}", "-o", "{out}/b.urdf"],
               ["export", "{branch}", "-o", "{out}/b.swc"]],
    "scene": [["scene", "{branch}", "--data", "{out}/s.npz"]],
    "others": [["verify", "{branch}"], ["bug-report", "{branch}", "-o", "{out}/b.zip"],
               ["status", "{in}/jobs.toml"], ["batch", "{in}/jobs.toml"],
               ["robot", "check", "{in}/cell.toml"]]}
"""Commands that take well under ten seconds with the values here. None moves a robot, or removes
files other than its own; `limber cache` does.
"""
_CODES = (0, 2, 3, 4, 130)


def _lines(name: str, _template: Path, folder: Path) -> list[Path]:
    files = []
    for number, line in enumerate(_LINES[name]):
        files.append(folder / f"{name}-{number}.json")
        files[-1].write_text(json.dumps(line))
    return files


@cache
def _options(name: str) -> list[tuple[str, Any]]:
    """Options of a stage's settings, and their defaults."""
    if name not in stage_summaries():
        return []
    return [(f"--{key.replace('_', '-')}", about.get("default"))
            for key, about in stage_schema(name)["settings"]["properties"].items()]


def with_further_option(line: list[str], rng: np.random.Generator) -> list[str]:
    """Add an option of the command to a line, with its default or a number in its place."""
    options = _options(line[0]) if line else []
    if not options:
        return line
    option, default = options[int(rng.integers(len(options)))]
    if isinstance(default, bool) or default is None:
        return [*line, option] if isinstance(default, bool) else [*line, option, "1"]
    values = default if isinstance(default, list | tuple) else [default]
    return [*line, option, *map(str, values)]


def _run(template: Path, path: Path) -> Any:
    from limber.cli.main import call

    try:
        line = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise InputError("no command line", "", "") from error
    if not isinstance(line, list) or not all(isinstance(word, str) for word in line) or not line:
        raise InputError("no command line", "", "")
    with tempfile.TemporaryDirectory(prefix="limber-line-") as place:
        words = [_filled(word, template, Path(place)) for word in line]
        told, result = io.StringIO(), io.StringIO()
        back = os.getcwd()
        os.chdir(place)
        try:
            with contextlib.redirect_stderr(told), contextlib.redirect_stdout(result):
                code = call([*words, "--json"])
        finally:
            os.chdir(back)
    if code not in _CODES or "Traceback" in told.getvalue() or "internal" in told.getvalue():
        raise RuntimeError(f"{code} of {line}: {told.getvalue()[-300:]}")
    last = (result.getvalue().strip().splitlines() or ["{}"])[-1]
    content = json.loads(last) if last.startswith("{") else {}
    if code:
        raise InputError(str(content.get("error") or told.getvalue() or "refused"), "", "")
    return content


def _filled(word: str, template: Path, place: Path) -> str:
    """A word with its placeholders filled; their files are made when they are first named."""
    if "{branch}" in word and not (place / "a.branch").exists():
        shutil.copytree(template, place / "a.branch")
    if "{in}" in word and not (place / "in").exists():
        _inputs(template, place / "in")
    (place / "out").mkdir(exist_ok=True)
    for name, folder in (("branch", "a.branch"), ("in", "in"), ("out", "out")):
        word = word.replace(f"{{{name}}}", str(place / folder))
    return word


def _inputs(template: Path, folder: Path) -> None:
    folder.mkdir()
    pull = template / "pulls" / "pull-1"
    for name in ("markers.csv", "robot.csv"):
        shutil.copyfile(pull / name, folder / name)
    shutil.copyfile(template / "skeleton.swc", folder / "branch.swc")
    times = np.arange(0, 4, 0.02)
    np.savetxt(folder / "ring.csv", np.column_stack(
        [times, np.exp(-0.5 * times) * np.cos(30 * times)]), "%.5f", ",",
               header="time_s,a_m_s2", comments="")
    (folder / "jobs.toml").write_text('[[job]]\nscans = ["none*.xyz"]\n')
    (folder / "cell.toml").write_text('[robot]\nmodel = "none"\n')


LINE_READERS = {
    f"limber {name}": Reader("words", partial(_lines, name), _run, True) for name in _LINES}
READERS: dict[str, Reader] = FILE_READERS | BRANCH_READERS | LINE_READERS
"""Readers by name."""


# --- the reading process ------------------------------------------------------------------------

MOST_SECONDS = 10.0
_LONGEST_WAIT = 120.0
MOST_BYTES = 2 << 30
_WORDS = ("read", "refused", "traceback", "not finite", "hang", "memory", "crash")


@dataclass
class Outcomes:
    """Results for the files of one reader.

    Attributes:
        counts: Number of files by outcome word.
        examples: The first failures: word, file kept, message.
    """

    counts: Counter = field(default_factory=Counter)
    examples: list[tuple[str, str, str]] = field(default_factory=list)

    @property
    def total(self) -> int:
        return sum(self.counts.values())

    @property
    def bad(self) -> int:
        return self.total - self.counts["read"] - self.counts["refused"]


def fuzz(names: list[str], setting: Setting, template: Path = TEMPLATE) -> dict[str, Outcomes]:
    """Give mutated files to readers, each as many as there is time for.

    Returns:
        Results by reader; files that did harm are moved to a folder ``harmful``.
    """
    found: dict[str, Outcomes] = {}
    keep = setting.kept / "harmful"
    keep.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="limber-fuzz-") as place:
        child = _Child(template)
        try:
            for name, budget in setting.budget.shares(names):
                if found and budget.remaining <= 0:
                    break
                setting.progress(len(found) / len(names), name)
                found[name] = _fuzzed(name, child, replace(setting, budget=budget), template,
                                      Path(place), keep)
        finally:
            child.close()
    return found


def _fuzzed(name: str, child: "_Child", setting: Setting, template: Path, place: Path,
            keep: Path) -> Outcomes:
    """Mutate the files of one reader."""
    reader, outcomes = READERS[name], Outcomes()
    originals = reader.make(template, place)
    rng = setting.generator(*name.encode())
    # Each original at least once.
    for index in setting.budget.seeds(0, setting.at_most(200, 20), at_least=len(originals)):
        original = originals[index % len(originals)]
        content = mutated(original.read_bytes(), reader.kind, rng)
        file = place / f"{index}-{original.name}"
        file.write_bytes(content)
        word, told = child.ask(name, file)
        outcomes.counts[word] += 1
        if word not in ("read", "refused"):
            kept = keep / f"{name.replace('/', '_')}-{word}-{file.name}"
            shutil.move(file, kept)
            outcomes.examples.append((word, str(kept), told))
        else:
            file.unlink(missing_ok=True)
    return outcomes


class _Child:
    """The reading process, started again when it dies."""

    def __init__(self, template: Path):
        self._template = template
        self._process: subprocess.Popen | None = None

    def ask(self, name: str, file: Path) -> tuple[str, str]:
        if self._process is None or self._process.poll() is not None:
            self._start()
        self._process.stdin.write(f"{name}\t{file}\n")
        self._process.stdin.flush()
        started, spent = time.monotonic(), self._processor_seconds()
        # Processor time, since other programs run beside it; a waiting reader does not use any.
        while (self._processor_seconds() - spent < MOST_SECONDS
               and time.monotonic() - started < _LONGEST_WAIT):
            try:
                line = self._lines.get(timeout=0.2)
            except Empty:
                if self._process.poll() is not None and self._lines.empty():
                    return "crash", f"ended with {self._process.returncode}"
                continue
            if line is None:
                self._process.wait()
                return "crash", f"ended with {self._process.returncode}"
            if line.startswith("{"):
                content = json.loads(line)
                return content["word"], content["told"]
        self.close()
        return "hang", f"over {MOST_SECONDS:g} s of processor time, or no end of waiting"

    def _processor_seconds(self) -> float:
        import psutil

        try:
            times = psutil.Process(self._process.pid).cpu_times()
            return times.user + times.system + times.children_user + times.children_system
        except psutil.NoSuchProcess:
            return 0.0

    def _start(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", "benchmarks.worker_fuzz", str(self._template)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        self._lines: Queue[str | None] = Queue()
        threading.Thread(target=self._read, args=(self._process.stdout, self._lines),
                         daemon=True).start()
        if not (self._lines.get(timeout=120) or "").startswith("ready"):
            raise RuntimeError("the reading process did not start")

    @staticmethod
    def _read(stream: Any, lines: "Queue[str | None]") -> None:
        for line in stream:
            lines.put(line)
        lines.put(None)

    def close(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()


def outcome(reader: Reader, file: Path, template: Path = TEMPLATE) -> tuple[str, str]:
    """What a reader makes of a file: a word, and the message."""
    try:
        result = reader.read(template, file)
    except LimberError as error:
        return ("refused", error.seen) if error.seen else ("traceback", "an error without a word")
    except MemoryError as error:
        return "memory", str(error)
    except (Exception, SystemExit) as error:
        import traceback

        where = traceback.extract_tb(error.__traceback__)[-3:]
        return "traceback", f"{type(error).__name__}: {error} at " + " < ".join(
            f"{Path(entry.filename).name}:{entry.lineno}" for entry in reversed(where))
    wrong = _not_finite(result, reader.may_lack)
    return ("not finite", wrong) if wrong else ("read", "")


def _not_finite(value: Any, may_lack: bool, place: str = "result", depth: int = 0) -> str:
    """Where a number is infinite, or NaN where it must not be; or an empty text."""
    if depth > 6:
        return ""
    if isinstance(value, float | np.floating):
        bad = np.isinf(value) or (np.isnan(value) and not may_lack)
        return f"{place} is {value}" if bad else ""
    if isinstance(value, np.ndarray):
        if value.dtype.kind != "f":
            return ""
        bad = np.isinf(value).any() or (np.isnan(value).any() and not may_lack)
        return place if bad else ""
    parts: Any = ()
    if isinstance(value, dict):
        parts = value.items()
    elif isinstance(value, list | tuple):
        parts = enumerate(value[:200])
    elif is_dataclass(value):
        parts = ((entry.name, getattr(value, entry.name)) for entry in fields(value))
    elif hasattr(value, "model_dump"):
        parts = value.model_dump().items()
    for key, part in parts:
        if found := _not_finite(part, may_lack, f"{place}.{key}", depth + 1):
            return found
    return ""


def _main(template: Path) -> None:
    import limber.store.loading  # noqa: F401  (imports take memory that no file asked for)

    resource.setrlimit(resource.RLIMIT_DATA, (MOST_BYTES, MOST_BYTES))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    print("ready", flush=True)
    for line in sys.stdin:
        name, file = line.rstrip("\n").split("\t")
        word, told = outcome(READERS[name], Path(file), template)
        assert word in _WORDS
        print("\n" + json.dumps({"word": word, "told": told[:400]}), flush=True)


def _asked(name: str) -> Asked:
    return Asked(f"mutated files, {name}", "an error or a valid result")


def _rows(setting: Setting, names: tuple[str, ...]) -> list[Row]:
    """One row for all readers, and one for each."""
    found, table = fuzz(list(names), setting), []
    for name, outcomes in found.items():
        told = ", ".join(f"{number} {word}" for word, number in sorted(outcomes.counts.items()))
        table.append(Row(*_asked(name), told, outcomes.bad == 0, outcomes.total))
        for word, file, message in outcomes.examples:
            print(f"{name}: {word}: {message} ({Path(file).name})")
    if len(names) == 1:
        return table
    bad, total = (sum(getattr(each, what) for each in found.values()) for what in ("bad", "total"))
    # A reader that was not run is not known to be good.
    is_met = False if bad else True if len(found) == len(names) else None
    return [Row(*_ALL, f"{bad} ({len(found)} of {len(names)} readers)", is_met, total), *table]


_ALL = Asked("mutated files, all readers: traceback, crash, hang over 10 s, over 2 GB, numbers not "
             "finite", "0")
PARTS = {"fuzz": Part(partial(_rows, names=tuple(READERS)), 60, (_ALL, *map(_asked, READERS)),
                      grows=True),
         **{f"fuzz:{name}": Part(partial(_rows, names=(name,)), 10, (_asked(name),), grows=True,
                                 alone=True) for name in READERS}}


if __name__ == "__main__":
    _main(Path(sys.argv[1]))
