"""Batches: memory over many jobs, kill -9 at random moments."""

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from benchmarks.table import Asked, Row, Setting
from benchmarks.worker_branch_files import TEMPLATE
from limber.batch.run import run_task
from limber.core.processes import Pool
from limber.stages.motion.load import ApplyLoads
from limber.stages.shape.generate import Generate

RECONSTRUCT = '[[job.stage]]\nrun = "reconstruct"\n'
MEMORY_ROW = Asked("memory over jobs in one worker, after the tenth", "under 5 %")


def memory(setting: Setting) -> list[Row]:
    """Memory of one worker over many jobs, after the tenth."""
    jobs = setting.at_most(100, 30)
    with tempfile.TemporaryDirectory(prefix="limber-bench-") as place, \
            Pool(1, name="a job of the bench") as pool:
        folder = Path(shutil.copytree(TEMPLATE, Path(place, "a.branch")))
        used = []
        for number in setting.budget.seeds(0, jobs, at_least=20):
            setting.progress(number / jobs, f"job {number + 1}")
            task = ApplyLoads(branch_folder=folder, wind=(3.0 + 0.01 * number, 0.0, 0.0))
            record = pool.submit(run_task, task, folder).result()
            if record.error:
                return [Row(*MEMORY_ROW, record.error, False, number)]
            used.append(record.memory_mb)
    grown = float(np.median(used[-5:]) / np.median(used[9:14]) - 1)
    return [Row(*MEMORY_ROW, f"{100 * grown:+.1f} % ({used[-1]:.0f} MB)", grown < 0.05, len(used))]


def make_scans(folder: Path, count: int, seed: int) -> None:
    """Write ``scan-0.ply`` and so on, generated branches, into a folder."""
    for number in range(count):
        made = folder / f"made-{number}"
        Generate(folder=made, seed=seed % 10_000 + number).run()
        (made / "cloud.ply").rename(folder / f"scan-{number}.ply")


def write_jobs(folder: Path, name: str, stages: str) -> Path:
    """Write ``NAME.toml``, which runs ``stages`` on the folder's scans and writes to NAME."""
    path = folder / f"{name}.toml"
    path.write_text(f'out = "{name}"\n[[job]]\nscans = ["scan-*.ply"]\n{stages}')
    return path


def start_batch(jobs: Path, workers: int, *more: str) -> subprocess.Popen:
    """Start `limber batch` on a job file, in a session of its own."""
    return subprocess.Popen(
        [sys.executable, "-m", "limber", "batch", str(jobs), "--workers", str(workers), *more],
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True,
        env=os.environ | {"LIMBER_CORES": str(workers)})


def manifests(out: Path) -> dict[str, dict]:
    """Return the manifest of each branch in ``out``."""
    found = {}
    for path in sorted(out.glob("*.branch/branch.json")):
        found[path.parent.name] = json.loads(path.read_text())
    return found


def digests(out: Path) -> dict[tuple[str, str], str]:
    """Return the sha256 of each listed file, by branch and name."""
    return {(branch, name): entry["sha256"] for branch, manifest in manifests(out).items()
            for name, entry in manifest["files"].items()}


# --- kills --------------------------------------------------------------------------------------

_DRAWS = 4  # for each kill, until the batch is still running at the moment drawn
_STAGES = RECONSTRUCT + """[[job.stage]]
run = "load"
name = "gale"
wind = [3.0, 0.0, 0.0]
"""
KILLS_ROW = Asked("kill -9 of batch and workers, or of a worker, at random moments (30 asked)",
                  "identical, nothing stored redone")
_BRANCHES = 2


def killed(setting: Setting) -> list[Row]:
    """Random moments, each in a new run of a batch of two branches, which then continues.

    Only kills while the batch was still running count.
    """
    with tempfile.TemporaryDirectory(prefix="limber-bench-") as place:
        folder = Path(place)
        make_scans(folder, _BRANCHES, setting.seed)
        started = time.perf_counter()
        code = start_batch(write_jobs(folder, "undisturbed", _STAGES), 1).wait()
        whole = time.perf_counter() - started
        wanted = digests(folder / "undisturbed")
        kills = setting.trials("kills", setting.seeds(30, 3), partial(
            _kill, folder=folder, whole=whole, wanted=wanted),
                               "store", "batch", "core", "stages", "geometry")
    redone, stored = (Counter(key for kill in kills for key in kill[name])
                      for name in ("redone", "found"))
    again = ", ".join(f"{key} {count} times" for key, count in redone.items()) or "nothing"
    apart, alone, ended = (sum(map(bool, wrong)) for wrong in (
        [kill["apart"] for kill in kills], [kill["is_alone"] for kill in kills],
        [kill["code"] == 0 for kill in kills]))
    told = (f"{len(kills)} kills, {alone} of one worker alone, {_BRANCHES} branches each; stored "
            f"when they fell: "
            f"{', '.join(f'{key} {count}' for key, count in stored.items()) or 'nothing'}; "
            f"{apart} runs with other files, redone: {again}, {ended} went on to the end")
    return [Row(*KILLS_ROW, told, bool(wanted) and code == 0 and apart == 0 and not redone
                and ended == len(kills), len(kills))]


def _kill(seed: int, folder: Path, whole: float, wanted: dict[tuple[str, str], str],
          ) -> dict[str, Any]:
    """One kill: ``moment`` is the fraction of an undisturbed run's time.

    ``found`` are the entries stored at the kill, ``redone`` those of them that the next run made
    again; ``apart`` is the number of files that differ from an undisturbed run's.
    """
    rng, name = np.random.default_rng(seed), f"killed-{seed}"
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
    return {"moment": moment, "is_alone": is_alone, "code": code,
            "found": sorted(key for _, key in stored),
            "redone": sorted(key for (branch, key), value in stored.items()
                             if now.get((branch, key)) != value),
            "apart": sum(files.get(key) != wanted.get(key) for key in files.keys() | wanted.keys())}


def _family(process: subprocess.Popen) -> list[int]:
    """The processes that a batch has started."""
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
