"""Mutated files given to every reader, in a process that may crash, hang or run out of memory.

``python -m benchmarks.worker_fuzz TEMPLATE`` is that process: each line of its input has a reader's
name and a file; it answers with one line of JSON.
"""

import json
import resource
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from queue import Empty, Queue
from typing import Any

import numpy as np

from benchmarks.table import Setting
from benchmarks.worker_mutations import mutated
from benchmarks.worker_readers import READERS, Reader
from limber.core.errors import LimberError

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


def fuzz(names: list[str], setting: Setting, template: Path, keep: Path) -> dict[str, Outcomes]:
    """Give mutated files to readers, each as many as there is time for.

    Returns:
        Results by reader; files that did harm are moved to ``keep``.
    """
    found: dict[str, Outcomes] = {}
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


def _outcome(reader: Reader, template: Path, file: Path) -> tuple[str, str]:
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
        word, told = _outcome(READERS[name], template, Path(file))
        assert word in _WORDS
        print("\n" + json.dumps({"word": word, "told": told[:400]}), flush=True)


if __name__ == "__main__":
    _main(Path(sys.argv[1]))
