"""Kill -9 of a batch with its workers, or of one worker, at random moments; then it continues.

A stopped campaign continues as well: with ``--out`` and ``--seed`` the earlier kills count.
"""

import contextlib
import os
import shutil
import signal
import subprocess
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.table import Asked, Row, Setting
from benchmarks.trial_log import keep, read_trials, source_digest
from benchmarks.worker_batches import (
    RECONSTRUCT,
    digests,
    make_scans,
    manifests,
    start_batch,
    write_jobs,
)

_DRAWS = 4  # for each kill, until the batch is still running at the moment drawn
_STAGES = RECONSTRUCT + """[[job.stage]]
run = "load"
name = "gale"
wind = [3.0, 0.0, 0.0]
"""


@dataclass(frozen=True)
class Kill:
    """Result of one kill: ``moment`` is the fraction of an undisturbed run's time.

    ``found`` are the entries stored at the kill, ``redone`` those of them that the next run made
    again; ``apart`` the files that differ from an undisturbed run's.
    """

    number: int
    seed: int
    sources: str
    moment: float
    is_alone: bool
    found: tuple[str, ...]
    redone: tuple[str, ...]
    apart: int
    code: int


KILLS_ROW = Asked("kill -9 of batch and workers, or of a worker, at random moments (30 asked)",
                  "identical, nothing stored redone")
_BRANCHES = 2


def killed(setting: Setting) -> list[Row]:
    """Random moments, each in a new run of a batch of two branches, which then continues.

    Only kills while the batch was still running count; those of an earlier run count too.
    """
    sources = source_digest(("store", "batch", "core", "stages", "geometry"), __file__)
    kept, kills = setting.kept / "kills.jsonl", setting.at_most(30, 3)
    made = {kill.number: kill for kill in read_trials(Kill, kept)
            if (kill.seed, kill.sources) == (setting.seed, sources) and kill.number < kills}
    with tempfile.TemporaryDirectory(prefix="limber-bench-") as place:
        folder = Path(place)
        make_scans(folder, _BRANCHES, setting.seed)
        started = time.perf_counter()
        code = start_batch(write_jobs(folder, "undisturbed", _STAGES), 1).wait()
        whole = time.perf_counter() - started
        wanted = digests(folder / "undisturbed")
        missing = [number for number in range(kills) if number not in made]
        for number in setting.budget.items(missing, at_least=0 if made else 1):
            setting.progress(number / kills, f"kill {number + 1} of {kills}")
            made[number] = _kill(folder, number, setting.seed, sources, whole, wanted)
            keep(made[number], kept)
            print(f"kill {made[number]}", flush=True)
    return [_row(list(made.values()), bool(wanted) and code == 0)]


def _row(kills: Sequence[Kill], is_valid: bool) -> Row:
    redone = Counter(key for kill in kills for key in kill.redone)
    again = ", ".join(f"{key} {count} times" for key, count in redone.items()) or "nothing"
    apart = sum(kill.apart > 0 for kill in kills)
    ended = sum(kill.code == 0 for kill in kills)
    stored = Counter(key for kill in kills for key in kill.found)
    told = (f"{len(kills)} kills, {sum(kill.is_alone for kill in kills)} of one worker alone, "
            f"{_BRANCHES} branches each; stored when they fell: "
            f"{', '.join(f'{key} {count}' for key, count in stored.items()) or 'nothing'}; "
            f"{apart} runs with other files, redone: {again}, {ended} went on to the end")
    return Row(*KILLS_ROW, told, is_valid and apart == 0 and not redone and ended == len(kills),
               len(kills))


def _kill(folder: Path, number: int, seed: int, sources: str, whole: float,
          wanted: dict[tuple[str, str], str]) -> Kill:
    rng = np.random.default_rng([seed, number])
    name = f"killed-{number}"
    jobs, out = write_jobs(folder, name, _STAGES), folder / name
    for _ in range(_DRAWS):
        moment = float(rng.uniform(0.2 / whole, 1.0))
        process = start_batch(jobs, 1)
        time.sleep(moment * whole)
        if process.poll() is None:
            break
        shutil.rmtree(out)
    family = _family(process)
    is_alone = bool(rng.random() >= 0.5 and family)
    if is_alone:
        _end([family[int(rng.integers(len(family)))]])
    else:
        _end([process.pid, *family])
    # A batch whose worker was killed first continues to its own end.
    stored = _entries(out)
    process.wait()
    code = start_batch(jobs, 1, "--retry-failed").wait()
    now, files = _entries(out), digests(out)
    shutil.rmtree(out)
    return Kill(number, seed, sources, round(moment, 4), is_alone,
                tuple(sorted(key for _, key in stored)),
                tuple(sorted(key for (branch, key), value in stored.items()
                             if now.get((branch, key)) != value)),
                sum(files.get(key) != wanted.get(key) for key in files.keys() | wanted.keys()),
                code)


def _family(process: subprocess.Popen) -> list[int]:
    """The processes that a batch has started."""
    import psutil

    try:
        return [child.pid for child in psutil.Process(process.pid).children(recursive=True)]
    except psutil.NoSuchProcess:
        return []


def _end(processes: Sequence[int]) -> None:
    for one in processes:
        with contextlib.suppress(ProcessLookupError):
            os.kill(one, signal.SIGKILL)


def _entries(out: Path) -> dict[tuple[str, str], str]:
    """Time at which each stored entry was made."""
    return {(branch, key): f"{entry['finished']} {entry['seconds']}"
            for branch, manifest in manifests(out).items()
            for key, entry in manifest["stages"].items()}
