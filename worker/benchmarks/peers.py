"""Other programs on the sparse scans, side by side: PyTLidar (TreeQSM) and PC-skeletor.

They live in an environment of their own, in the user's cache, which the first run makes from the
registry. Their clouds are turned so that the true root is the lowest, as TreeQSM wants.
"""

import contextlib
import os
import subprocess
import sys
import tempfile
from dataclasses import replace
from functools import partial
from itertools import product, zip_longest
from pathlib import Path
from typing import Any

import numpy as np
import platformdirs

from benchmarks import peer_programs
from benchmarks.sparse_scans import (
    GROUPS,
    Subject,
    along,
    compared,
    real_tasks,
    runs,
    subject,
    world_tasks,
)
from benchmarks.table import Asked, Row, Setting
from limber.core.constants import UNIT_METRES
from limber.geometry.skeleton.skeleton import shortest_turn

_PACKAGES = ("PyTLidar==1.1.2", "open3d==0.20.0", "robust-laplacian", "networkx", "imageio", "tqdm",
             "wget", "scikit-learn", "libusb-package")
_ALONE = ("pc-skeletor==1.0.0", "mistree==2.0.0")  # they pin a Fortran build, and want PyTorch
_KINDS = GROUPS | {"real scans with curated axes": ()}
_PROGRAMS = ("Limber", *peer_programs.PROGRAMS)
PEERS = tuple(Asked(f"sparse, {kind}, {program}: axes found / own; length and volume over the "
                    "true, radius bias, medians; processor time", "report")
              for kind, program in product(_KINDS, _PROGRAMS))


def environment() -> Path:
    """Return the Python of the other programs' environment, which is made if it is not there.

    Raises:
        subprocess.CalledProcessError: the registry cannot be reached, or does not have them.
    """
    place = platformdirs.user_cache_path("limber") / "bench-peers"
    python, ready = place / "bin" / "python", place / "ready"
    pip = (python, "-m", "pip", "install", "-q")
    if not ready.is_file():
        for words in ((sys.executable, "-m", "venv", place), (*pip, *_PACKAGES),
                      (*pip, "--no-deps", *_ALONE)):
            subprocess.run([str(word) for word in words], check=True, capture_output=True,
                           text=True)
        ready.touch()
    return python


def rows(setting: Setting) -> list[Row]:
    """Limber and the others on the same clouds; one row for each kind of scan and program."""
    try:
        python = environment()
    except (subprocess.CalledProcessError, OSError) as error:
        why = (getattr(error, "stderr", "") or str(error)).strip().splitlines()[-1]
        return [Row(*asked, f"skipped, they cannot be installed: {why}", None, 0)
                for asked in PEERS]
    tasks = [task for task in world_tasks(setting) + real_tasks(setting)
             if subject(task[0], task[2]).axes is not None]
    kinds = {kind: [task for task in tasks if task[0].split(":")[0] in sources or not (
        sources or ":" in task[0])] for kind, sources in _KINDS.items()}
    # Of each kind in turn, in half of the time: the others need some too.
    ours = runs(replace(setting, budget=setting.budget.part(setting.budget.remaining / 2)),
                [task for each in zip_longest(*kinds.values()) for task in each if task])
    tasks = [trial.task for trial in ours]
    done = {"Limber": [trial.values | ({"failure": trial.failure} if trial.failure else {})
                       for trial in ours]}
    for name in peer_programs.PROGRAMS:
        trial, = setting.trials("peers", [(name, setting.seed, len(tasks))], partial(
            _of_peer, python=python, tasks=tasks))
        done[name] = trial["each"]
    return [_row(asked, [values for task, values in zip(tasks, done[program], strict=True)
                         if task in kinds[kind]])
            for asked, (kind, program) in zip(PEERS, product(kinds, done), strict=True)]


def _of_peer(which: tuple[str, int, int], python: Path, tasks: list[tuple[str, str, int]],
             ) -> dict[str, Any]:
    """What a program gives of each scan: the numbers of its row, or ``failure``."""
    known = [subject(name, seed) for name, _, seed in tasks]
    with tempfile.TemporaryDirectory() as place:
        files = [Path(place, f"{number:03d}.npz") for number in range(len(known))]
        for one, file in zip(known, files, strict=True):
            turn, shift = _frame(one)
            np.save(file.with_suffix(".npy"), (_metres(one) - shift) @ turn.T)
        # A program may crash or hang: what it has done by then counts.
        with contextlib.suppress(subprocess.TimeoutExpired):
            subprocess.run([str(python), "-P", peer_programs.__file__, which[0], place],
                           check=False, capture_output=True, cwd=place,
                           timeout=90 + 2 * len(tasks), env=os.environ | {"MPLBACKEND": "agg"})
        return {"each": [_numbers(*pair) for pair in zip(known, files, strict=True)]}


def _metres(known: Subject) -> np.ndarray:
    return known.cloud.points * UNIT_METRES[known.settings.get("unit", "m")]


def _frame(known: Subject) -> tuple[np.ndarray, np.ndarray]:
    """Rotation [3, 3] and origin [m] of a frame whose z leads from the root to the middle."""
    points = _metres(known)
    if known.root is None:
        return np.eye(3), points.min(axis=0)
    return shortest_turn(points.mean(axis=0) - known.root, np.array([0.0, 0.0, 1.0])), known.root


def _numbers(known: Subject, file: Path) -> dict[str, Any]:
    """How right a program's axes are; its radii are NaN where it has none."""
    if not file.is_file():
        why = file.with_suffix(".txt")
        return {"failure": why.read_text() if why.is_file() else "no answer in time, or it crashed"}
    turn, shift = _frame(known)
    with np.load(file) as given:
        segments, radii, seconds = (given[key] for key in ("segments", "radii", "seconds"))
    length = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1)
    places, count = along(segments @ turn + shift)
    volume = float((np.pi * radii**2 * length).sum())
    return compared(known, places, np.repeat(radii, count)) | {
        "length_m": float(length.sum()), "cpu_s": float(seconds),
        **({"volume_m3": volume} if np.isfinite(volume) else {}),
        **({"true_volume_m3": known.volume} if known.volume else {})}


def _row(asked: Asked, each: list[dict[str, Any]]) -> Row:
    done = [values for values in each if "failure" not in values]
    failed = sorted({values["failure"].splitlines()[0][:90] for values in each
                     if "failure" in values})
    if not done:
        return Row(*asked, "; ".join(failed), None, len(each)) if each else asked.not_shown()

    def told(text: str, values: list[float]) -> str:
        known = [value for value in values if value is not None and np.isfinite(value)]
        return text.format(float(np.median(known))) if known else "-"

    ratio = {key: [values[f"{key}"] / values[f"true_{key}"] for values in done
                   if key in values and f"true_{key}" in values]
             for key in ("length_m", "volume_m3")}
    text = "; ".join((
        " / ".join(f"{100 * np.mean([values[key] for values in done]):.0f}"
                   for key in ("found", "own")) + " %",
        told("length {:.2f}", ratio["length_m"]), told("volume {:.2f}", ratio["volume_m3"]),
        told("radii {:+.0%}", [values.get("radius_bias") for values in done]),
        told("{:.1f} s", [values["cpu_s"] for values in done])))
    lost = f"; {len(each) - len(done)} failed: {'; '.join(failed[:2])}" if failed else ""
    return Row(*asked, text + lost, None, len(each))
