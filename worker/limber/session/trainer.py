"""The process beside a session that makes its reduced model, checks it and refreshes it.

It holds the full model, so that the session never waits for it. JSON lines, as in
:mod:`limber.session.worker`:

- on standard input ``{"command": "check", "id", "pose", "young_pa"}``; the end of input ends it;
- on standard output ``{"progress", "message"}``, ``{"event": "model", "path", "size", "seconds"}``
  whenever a model is ready, and ``{"event": "check", "id", "position_error", "energy_error",
  "certain", "learned"}``.

A model is kept in the user's cache folder, named after all that it depends on.
"""

import argparse
import hashlib
import json
import os
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import platformdirs

from limber.errors import InputError, LimberError
from limber.mechanics.grasp import Grasp
from limber.mechanics.model import BranchModel
from limber.mechanics.reduced.model import (
    FORMAT,
    ReducedModel,
    ReducedSettings,
    as_control_points,
)
from limber.mechanics.reduced.refresh import RefreshingModel
from limber.mechanics.reduced.training import Snapshots, TrainingSettings
from limber.progress import JsonSink, Progress
from limber.store import Branch


def session_arguments(parser: argparse.ArgumentParser) -> argparse.ArgumentParser:
    """Add what the session and its trainer are both told."""
    parser.add_argument("folder", type=Path, help="the branch folder")
    parser.add_argument("--mode", choices=("clamped", "pinned"), default="clamped",
                        help="what the grasp holds: the pose, or the position alone")
    parser.add_argument("--grasps", type=int, default=160, help="full solutions to learn from")
    parser.add_argument("--size", type=int, default=80, help="reduced coordinates")
    parser.add_argument("--fields", type=int, default=130, help="reduced strain fields")
    parser.add_argument("--young-spread", type=float, default=1.0,
                        help="factor within which Young's modulus will change; 1: it stays")
    parser.add_argument("--cache", type=Path, help="folder for models; default the user's cache")
    parser.add_argument("--no-cache", action="store_true", help="neither use nor keep a model")
    return parser


def settings_of(options: argparse.Namespace) -> ReducedSettings:
    """Return the reduced model's settings of command-line options."""
    training = TrainingSettings(grasp_count=options.grasps, young_spread=options.young_spread)
    return ReducedSettings(size=options.size, field_count=options.fields, training=training,
                           vibration_count=1 if options.young_spread == 1 else 0)


def load_branch(options: argparse.Namespace) -> tuple[BranchModel, Grasp]:
    """Return the model and grasp of a branch folder."""
    model = BranchModel.from_branch(Branch.open(options.folder))
    return model, Grasp.from_mesh(model.mesh, options.mode)


def model_key(model: BranchModel, grasp: Grasp, settings: ReducedSettings) -> str:
    """Return a digest of all that a reduced model depends on."""
    digest = hashlib.sha256(f"{FORMAT} {settings!r} {grasp.mode} {model.damping!r}".encode())
    digest.update(model.mesh.geometry_digest().encode())
    for array in (model.young, model.poisson, model.density, model.gravity, grasp.nodes,
                  model.fixed):
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:32]


class ModelCache:
    """Reduced models and their snapshots in a folder."""

    def __init__(self, folder: Path, key: str):
        self.model_path = folder / f"{key}.npz"
        self._snapshot_path = folder / f"{key}-snapshots.npz"
        folder.mkdir(parents=True, exist_ok=True)

    def load(self) -> tuple[ReducedModel, Snapshots] | None:
        """Return what is there, or None if it is not there or damaged."""
        if not (self.model_path.is_file() and self._snapshot_path.is_file()):
            return None
        try:
            with np.load(self._snapshot_path, allow_pickle=False) as data:
                snapshots = Snapshots.from_arrays({name: data[name] for name in data.files})
            return ReducedModel.read(self.model_path), snapshots
        except (InputError, OSError, ValueError, KeyError):
            return None

    def store(self, reduced: ReducedModel, snapshots: Snapshots) -> None:
        """Keep a model; a reader sees the old or the new one."""
        for path, write in ((self._snapshot_path, lambda p: _save(p, snapshots)),
                            (self.model_path, reduced.write)):
            part = path.with_suffix(f".{os.getpid()}.part")
            write(part)
            os.replace(part, path)


def _save(path: Path, snapshots: Snapshots) -> None:
    with open(path, "wb") as stream:
        np.savez(stream, **snapshots.arrays())


def say(**line: Any) -> None:
    """Print one JSON line."""
    print(json.dumps(line, default=float), flush=True)


def main(arguments: list[str] | None = None) -> int:
    """Run the trainer until its input ends."""
    options = session_arguments(argparse.ArgumentParser(description=__doc__)).parse_args(arguments)
    if hasattr(os, "nice"):
        os.nice(5)  # the session answers first
    try:
        with tempfile.TemporaryDirectory(prefix="limber-reduced-") as own:
            _serve(options, Path(own))
    except LimberError as error:
        say(event="error", message=str(error))
        return error.exit_code
    return 0


def _serve(options: argparse.Namespace, own: Path) -> None:
    model, grasp = load_branch(options)
    settings = settings_of(options)
    folder = own if options.no_cache else options.cache or (
        platformdirs.user_cache_path("limber") / "reduced")
    cache = ModelCache(folder, model_key(model, grasp, settings))
    began = time.perf_counter()
    known = None if options.no_cache else cache.load()
    weights, young = as_control_points(model)
    progress = Progress(JsonSink(interval_seconds=0.5))
    reduced, snapshots = known or (None, None)
    refreshing = RefreshingModel(model, grasp, weights, young, settings, reduced=reduced,
                                 snapshots=snapshots, progress=progress)
    if known is None:
        cache.store(refreshing.reduced, refreshing.snapshots)
    _announce(cache, refreshing, began)
    _step_back()
    for line in sys.stdin:
        request = json.loads(line)
        if request.get("command") != "check":
            continue
        began, count = time.perf_counter(), refreshing.refresh_count
        _check(refreshing, request)
        if refreshing.refresh_count > count:
            cache.store(refreshing.reduced, refreshing.snapshots)
            _announce(cache, refreshing, began)


def _step_back() -> None:
    """Run only when a core has nothing else to do: the session holds 60 Hz now.

    Before there is a model the session waits for it, and less patience is called for.
    """
    if hasattr(os, "SCHED_IDLE"):
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    elif hasattr(os, "nice"):
        os.nice(14)


def _check(refreshing: RefreshingModel, request: dict[str, Any]) -> None:
    pose, young = np.array(request["pose"], float), np.array(request["young_pa"], float)
    state = refreshing.reduced.with_young(young).solve_static(pose)
    estimate = refreshing.check(state)
    good = refreshing.accepts(state, estimate)
    learned = not good and refreshing.learn(pose, young, estimate).converged
    say(event="check", id=request.get("id", 0), position_error=_finite(estimate.position),
        energy_error=_finite(estimate.energy), certain=estimate.certain, good=good,
        learned=learned)


def _announce(cache: ModelCache, refreshing: RefreshingModel, began: float) -> None:
    say(event="model", path=str(cache.model_path), size=refreshing.reduced.size,
        snapshots=len(refreshing.snapshots), refreshes=refreshing.refresh_count,
        seconds=round(time.perf_counter() - began, 3))


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


if __name__ == "__main__":
    sys.exit(main())
