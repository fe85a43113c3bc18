"""Batches: two cores against one, on Dask, memory over many jobs."""

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.table import Asked, Row, Setting
from limber.batch.jobs.branch_jobs import StageTask
from limber.batch.stage_task import run_task
from limber.core.processes import Pool
from limber.core.progress import SILENT
from limber.stages.registry import stage_description
from limber.stages.shape.generate import GenerateInputs, GenerateSettings

RECONSTRUCT = '[[job.stage]]\nrun = "reconstruct"\n'
_ESTIMATE = ('[[job.stage]]\nrun = "virtual-pull"\nname = "pull-1"\n'
             '[[job.stage]]\nrun = "estimate"\n')


MEMORY_ROW = Asked("memory over jobs in one worker, after the tenth", "under 5 %")
DASK_ROWS = (
    Asked("branches on a Dask scheduler and two workers, against the pool", "within 15 %"),
    Asked("their files, times aside", "bit for bit the same"))
SPEED_UP_ROW = Asked("generated branches, reconstruct and estimate: two workers against one",
                     "1.8 times")


def speed_up(setting: Setting) -> list[Row]:
    """As many branches as there is time for, with one and with two workers."""
    with tempfile.TemporaryDirectory(prefix="limber-bench-") as place:
        folder = Path(place)
        # With one worker each takes its time, with two about half of it.
        count = _fitting(setting, folder, setting.at_most(40, 4), 1.5)
        make_scans(folder, count, setting.seed)
        seconds, done = [], []
        for workers in (1, 2):
            setting.progress(0.5 * (workers - 1), f"{workers} worker(s)")
            jobs = write_jobs(folder, f"by-{workers}", RECONSTRUCT + _ESTIMATE)
            started = time.perf_counter()
            start_batch(jobs, workers).wait()
            seconds.append(time.perf_counter() - started)
            done.append(sum("estimate" in manifest["stages"]
                            for manifest in manifests(folder / f"by-{workers}").values()))
    times = seconds[0] / seconds[1]
    return [Row(*SPEED_UP_ROW, f"{times:.2f} times ({seconds[0]:.0f} s, {seconds[1]:.0f} s); "
                f"{done[0]} and {done[1]} have an estimate",
                times >= 1.8 and done[0] == done[1] > 0.9 * count, count)]


def on_dask(setting: Setting) -> list[Row]:
    """The same jobs on the pool's two processes and on a Dask scheduler with two workers."""
    with tempfile.TemporaryDirectory(prefix="limber-bench-") as place:
        folder = Path(place)
        count = _fitting(setting, folder, setting.at_most(8, 2), 1.0)
        make_scans(folder, count, setting.seed)
        seconds, codes = [], []
        for number, where in enumerate(("pool", "dask")):
            setting.progress(0.5 * number, where)
            jobs = write_jobs(folder, where, RECONSTRUCT + _ESTIMATE)
            started = time.perf_counter()
            words = ["--cluster", "local"] if where == "dask" else []
            codes.append(start_batch(jobs, 2, *words).wait())
            seconds.append(time.perf_counter() - started)
        one, other = (_contents(folder / where) for where in ("pool", "dask"))
        apart = sorted(key for key in one.keys() | other.keys() if one.get(key) != other.get(key))
        print("files apart:", apart)
    more = seconds[1] / seconds[0] - 1
    return [
        Row(*DASK_ROWS[0], f"{100 * more:+.1f} % ({seconds[0]:.0f} s, {seconds[1]:.0f} s)",
            more <= 0.15 and codes == [0, 0], count),
        Row(*DASK_ROWS[1], f"{len(apart)} of {len(one)} apart", not apart and len(one) > 0, count)]


def _fitting(setting: Setting, folder: Path, at_most: int, times: float) -> int:
    """Number of branches that fit if each takes ``times`` its time alone; at least 2, one timed."""
    trial = folder / "timed"
    trial.mkdir()
    started = time.perf_counter()
    make_scans(trial, 1, setting.seed)
    start_batch(write_jobs(trial, "alone", RECONSTRUCT + _ESTIMATE), 1).wait()
    each = times * (time.perf_counter() - started)
    return int(np.clip(setting.budget.remaining / each, 2, at_most))


def memory(setting: Setting, template: Path) -> Row:
    """Memory of one worker over many jobs, after the tenth."""
    jobs = setting.at_most(100, 30)
    with tempfile.TemporaryDirectory(prefix="limber-bench-") as place, \
            Pool(1, name="a job of the bench") as pool:
        folder = Path(shutil.copytree(template, Path(place, "a.branch")))
        stage = stage_description("load")
        used = []
        for number in setting.budget.seeds(0, jobs, at_least=20):
            setting.progress(number / jobs, f"job {number + 1}")
            task = StageTask("load", stage.inputs(branch_folder=folder), stage.settings(
                wind=(3.0 + 0.01 * number, 0.0, 0.0)), stage.options())
            outcome = pool.submit(run_task, task, folder).result()
            if outcome["error"]:
                return Row(*MEMORY_ROW, outcome["error"], False, number)
            used.append(outcome["memory_mb"])
    grown = float(np.median(used[-5:]) / np.median(used[9:14]) - 1)
    return Row(*MEMORY_ROW, f"{100 * grown:+.1f} % ({used[-1]:.0f} MB)", grown < 0.05, len(used))


def make_scans(folder: Path, count: int, seed: int) -> None:
    """Write ``scan-0.ply`` and so on, generated branches, into a folder."""
    for number in range(count):
        made = folder / f"made-{number}"
        settings = GenerateSettings(seed=seed % 10_000 + number)
        stage_description("generate").run(GenerateInputs(folder=made), settings, None, SILENT)
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


def _contents(out: Path) -> dict[tuple[str, str], str]:
    """Each branch's listed files; of an estimate without the seconds of its evaluations."""
    found = digests(out)
    for branch, name in found:
        if name == "estimate.json":
            told = json.loads((out / branch / name).read_text())
            for entry in told["history"]:
                entry.pop("seconds", None)
            found[branch, name] = json.dumps(told)
    return found
