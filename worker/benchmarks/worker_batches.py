"""Batches: two cores against one, kills at random moments, memory over many jobs."""

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
from pathlib import Path

import numpy as np

from benchmarks.table import Row
from limber.batch.job_file import StageTask
from limber.batch.task import run_task
from limber.jobs import Pool
from limber.progress import SILENT, Progress
from limber.stages.generate import GenerateInputs, GenerateSettings
from limber.stages.registry import stage_description

_STAGES = '[[job.stage]]\nrun = "reconstruct"\n'
_ESTIMATE = ('[[job.stage]]\nrun = "virtual-pull"\nname = "pull-1"\n'
             '[[job.stage]]\nrun = "estimate"\n')


def speed_up(count: int, seed: int, progress: Progress) -> Row:
    """``count`` branches, reconstruct and estimate, with one and with two workers."""
    with tempfile.TemporaryDirectory(prefix="limber-bench-") as place:
        folder = Path(place)
        _scans(folder, count, seed)
        seconds = []
        for workers in (1, 2):
            progress(0.5 * (workers - 1), f"{workers} worker(s)")
            jobs = _jobs(folder, f"by-{workers}", _STAGES + _ESTIMATE)
            started = time.perf_counter()
            _batch(jobs, workers).wait()
            seconds.append(time.perf_counter() - started)
    times = seconds[0] / seconds[1]
    return Row(f"{count} generated branches, reconstruct and estimate: two workers against one",
               "1.8 times", f"{times:.2f} times ({seconds[0]:.0f} s, {seconds[1]:.0f} s)",
               times >= 1.8)


def on_dask(count: int, seed: int, progress: Progress) -> list[Row]:
    """The same jobs on the pool's two processes and on a Dask scheduler with two workers."""
    with tempfile.TemporaryDirectory(prefix="limber-bench-") as place:
        folder = Path(place)
        _scans(folder, count, seed)
        seconds, codes = [], []
        for number, where in enumerate(("pool", "dask")):
            progress(0.5 * number, where)
            jobs = _jobs(folder, where, _STAGES + _ESTIMATE)
            started = time.perf_counter()
            words = ["--cluster", "local"] if where == "dask" else []
            codes.append(_batch(jobs, 2, *words).wait())
            seconds.append(time.perf_counter() - started)
        one, other = (_contents(folder / where) for where in ("pool", "dask"))
        apart = sorted(key for key in one.keys() | other.keys() if one.get(key) != other.get(key))
        print("files apart:", apart)
    more = seconds[1] / seconds[0] - 1
    return [
        Row(f"{count} branches on a Dask scheduler and two workers, against the pool",
            "within 15 %", f"{100 * more:+.1f} % ({seconds[0]:.0f} s, {seconds[1]:.0f} s)",
            more <= 0.15 and codes == [0, 0]),
        Row("their files, times aside", "bit for bit the same",
            f"{len(apart)} of {len(one)} apart", not apart and len(one) > 0)]


def killed(kills: int, branches: int, seed: int, progress: Progress) -> Row:
    """Kill -9 of the batch with its workers, or of one worker, at a random moment of a new run
    each time; then let it go on to its end.

    The key ``skeleton`` is what a reconstruct keeps before it is through: one that is cut off
    after that finds the skeleton again.
    """
    rng = np.random.default_rng(seed)
    with tempfile.TemporaryDirectory(prefix="limber-bench-") as place:
        folder = Path(place)
        _scans(folder, branches, seed)
        started = time.perf_counter()
        code = _batch(_jobs(folder, "undisturbed", _STAGES), 1).wait()
        whole = time.perf_counter() - started
        wanted = _digests(folder / "undisturbed")
        apart = alone = amid = 0
        redone: Counter[str] = Counter()
        for number in range(kills):
            progress(number / kills, f"kill {number + 1} of {kills}")
            name = f"killed-{number}"
            jobs, out = _jobs(folder, name, _STAGES), folder / name
            process = _batch(jobs, 1)
            time.sleep(float(rng.uniform(0.2, whole)))
            amid += process.poll() is None
            if rng.random() < 0.5:
                _kill(process, _family(process))
            else:
                alone += _kill_one(process, rng)
            kept = _finished(out)
            code = code or _batch(jobs, 1, "--retry-failed").wait()
            now = _finished(out)
            redone.update(key for (branch, key), value in kept.items()
                          if now.get((branch, key)) != value)
            apart += _digests(out) != wanted
            shutil.rmtree(out)
            print(f"kill {number + 1} of {kills}: {apart} with other files, redone: "
                  f"{dict(redone)}, exit {code}; {amid} while it ran, {alone} of one worker",
                  flush=True)
    again = ", ".join(f"{key} {count} times" for key, count in redone.items()) or "nothing"
    told = (f"{apart} runs with other files, redone: {again}, exit {code}; {kills} kills, "
            f"{amid} while it ran, {alone} of one worker alone; {branches} branches each")
    return Row("kill -9 of batch and workers, or of a worker, at random moments (30 asked)",
               "identical, nothing stored redone", told,
               bool(wanted) and apart == 0 and not redone and code == 0)


def memory(jobs: int, template: Path, progress: Progress) -> Row:
    """Memory of one worker over many jobs, after the tenth."""
    with tempfile.TemporaryDirectory(prefix="limber-bench-") as place, \
            Pool(1, name="a job of the bench") as pool:
        folder = Path(shutil.copytree(template, Path(place, "a.branch")))
        stage = stage_description("load")
        used = []
        for number in range(jobs):
            progress(number / jobs, f"job {number + 1}")
            task = StageTask("load", stage.inputs(branch_folder=folder), stage.settings(
                wind=(3.0 + 0.01 * number, 0.0, 0.0)), stage.options())
            outcome = pool.submit(run_task, task, folder).result()
            if outcome["error"]:
                return Row("memory over jobs in one worker", "under 5 %", outcome["error"], None)
            used.append(outcome["memory_mb"])
    grown = float(np.median(used[-5:]) / np.median(used[9:14]) - 1)
    return Row(f"memory over {jobs} jobs in one worker, after the tenth", "under 5 %",
               f"{100 * grown:+.1f} % ({used[-1]:.0f} MB)", grown < 0.05)


def _scans(folder: Path, count: int, seed: int) -> None:
    for number in range(count):
        made = folder / f"made-{number}"
        settings = GenerateSettings(seed=seed % 10_000 + number)
        stage_description("generate").run(GenerateInputs(folder=made), settings, None, SILENT)
        (made / "cloud.ply").rename(folder / f"scan-{number}.ply")


def _jobs(folder: Path, name: str, stages: str) -> Path:
    path = folder / f"{name}.toml"
    path.write_text(f'out = "{name}"\n[[job]]\nscans = ["scan-*.ply"]\n{stages}')
    return path


def _batch(jobs: Path, workers: int, *more: str) -> subprocess.Popen:
    return subprocess.Popen(
        [sys.executable, "-m", "limber", "batch", str(jobs), "--workers", str(workers), *more],
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True,
        env=os.environ | {"LIMBER_CORES": str(workers)})


def _family(process: subprocess.Popen) -> list[int]:
    """The processes that a batch has started."""
    import psutil

    try:
        return [child.pid for child in psutil.Process(process.pid).children(recursive=True)]
    except psutil.NoSuchProcess:
        return []


def _kill(process: subprocess.Popen, others: list[int]) -> None:
    for one in (process.pid, *others):
        with contextlib.suppress(ProcessLookupError):
            os.kill(one, signal.SIGKILL)
    process.wait()


def _kill_one(process: subprocess.Popen, rng: np.random.Generator) -> bool:
    """Kill one of the batch's processes, if it has any; the batch itself goes on to its end."""
    family = _family(process)
    if family:
        with contextlib.suppress(ProcessLookupError):
            os.kill(family[int(rng.integers(len(family)))], signal.SIGKILL)
    process.wait()
    return bool(family)


def _manifests(out: Path) -> dict[str, dict]:
    found = {}
    for path in sorted(out.glob("*.branch/branch.json")):
        found[path.parent.name] = json.loads(path.read_text())
    return found


def _finished(out: Path) -> dict[tuple[str, str], str]:
    """When each stored stage was made."""
    return {(branch, key): f"{entry['finished']} {entry['seconds']}"
            for branch, manifest in _manifests(out).items()
            for key, entry in manifest["stages"].items()}


def _digests(out: Path) -> dict[tuple[str, str], str]:
    return {(branch, name): entry["sha256"] for branch, manifest in _manifests(out).items()
            for name, entry in manifest["files"].items()}


def _contents(out: Path) -> dict[tuple[str, str], str]:
    """Each branch's listed files; of an estimate without the seconds of its evaluations."""
    found = _digests(out)
    for branch, name in found:
        if name == "estimate.json":
            told = json.loads((out / branch / name).read_text())
            for entry in told["history"]:
                entry.pop("seconds", None)
            found[branch, name] = json.dumps(told)
    return found
