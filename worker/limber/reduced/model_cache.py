"""A cache of trained reduced models.

Training takes minutes and depends only on the branch, its material and weight, the held patch and
the training settings: a digest of these is the file's name. One file contains the model and the
full solutions it was made from, so that a reader never sees two that do not belong together. ::

    learnt = learnt_model(model, grasp, weights, control_young, settings,
                          cache=ReducedCache(default_folder()))
    learnt.reduced.solve_static(pose)

A session, an energy field and an estimate may share the folder.
"""

import contextlib
import hashlib
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import platformdirs
from filelock import FileLock, Timeout

from limber.core.errors import InputError
from limber.core.files.reading import read_arrays
from limber.core.progress import SILENT, Progress
from limber.mechanics.grasp import Grasp
from limber.mechanics.model import BranchModel
from limber.reduced.building import build_reduced
from limber.reduced.model_file import FORMAT, read_model, write_model
from limber.reduced.reduced_model import ReducedModel
from limber.reduced.state import ReducedSettings
from limber.reduced.training import Snapshots, TrainingSettings

LIMIT_BYTES = 2 << 30
"""Largest size of all models of a folder: a dozen for a branch of some thousand tetrahedra."""
SHARED = ReducedSettings(size=80, vibration_count=1, field_count=130, training=TrainingSettings(
    grasp_count=160, young_spread=1.0))
"""Default training of a branch whose moduli are known."""
SNAPSHOT_PREFIX = "snapshot_"
_LEFT_OVER_SECONDS = 24 * 3600.0
_WAIT_SECONDS = 0.5


def default_folder() -> Path:
    """Return the folder in the user's cache that sessions and stages share."""
    return platformdirs.user_cache_path("limber") / "reduced"


def model_key(model: BranchModel, grasp: Grasp, weights: np.ndarray, control_young: np.ndarray,
              settings: ReducedSettings) -> str:
    """Return a digest of all that a reduced model depends on."""
    digest = hashlib.sha256(
        f"{FORMAT} {settings!r} {grasp.mode} {model.damping!r} {model.material.kernel}"
        f" False {sorted(map(repr, model.point_masses))}".encode())
    digest.update(model.mesh.geometry_digest().encode())
    for array in (weights, control_young, model.poisson, model.density, model.gravity,
                  grasp.nodes, grasp.weights, model.fixed):
        digest.update(np.ascontiguousarray(array).tobytes())
    if model.prestress is not None:
        digest.update(np.ascontiguousarray(model.prestress.total.stress).tobytes())
    return digest.hexdigest()[:32]


class ReducedCache:
    """Reduced models in a folder, the least recently used removed where they take too much room.

    Args:
        folder: Where; made if it is not there.
        limit_bytes: What all models may take; the one stored last always stays.
        progress: Told of files that were damaged and are removed, and of a folder that cannot be
            written: models are then trained, and not kept.
    """

    def __init__(self, folder: Path, *, limit_bytes: int = LIMIT_BYTES,
                 progress: Progress = SILENT):
        self.folder, self.limit_bytes, self._progress = Path(folder), limit_bytes, progress
        self._is_reported = False
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            self.tell(error)

    def tell(self, error: OSError) -> None:
        """Warn, once, that models cannot be kept."""
        if not self._is_reported:
            self._is_reported = True
            self._progress.warn(f"Reduced models cannot be stored in {self.folder} "
                                f"({error.strerror or error}). They are trained again each time.")

    def path(self, key: str) -> Path:
        """Return the file of a model; :func:`read_model` reads it."""
        return self.folder / f"{key}.npz"

    def load(self, key: str) -> tuple[ReducedModel, Snapshots] | None:
        """Return a model and its full solutions; None if there is none.

        A damaged file is removed, and said.
        """
        path = self.path(key)
        if not path.is_file():
            return None
        try:
            held = {name.removeprefix(SNAPSHOT_PREFIX): values
                    for name, values in read_arrays(path, "a reduced model").items()
                    if name.startswith(SNAPSHOT_PREFIX)}
            found = read_model(path), Snapshots.from_arrays(held)
        except (InputError, OSError, ValueError, KeyError, TypeError) as error:
            self._progress.warn(f"{path.name} in the cache of reduced models was damaged "
                      f"({type(error).__name__}); it is deleted, and the model is trained again")
            with contextlib.suppress(OSError):
                path.unlink()
            return None
        with contextlib.suppress(OSError):
            os.utime(path)  # used now: others are evicted before it
        return found

    def store(self, key: str, reduced: ReducedModel, snapshots: Snapshots) -> Path:
        """Keep a model; a reader sees the old or the new one, whole. Returns its file."""
        path = self.path(key)
        part = path.with_suffix(f".{os.getpid()}.part")
        try:
            write_model(reduced, part, {SNAPSHOT_PREFIX + name: array
                                        for name, array in snapshots.arrays().items()})
            os.replace(part, path)
        finally:
            part.unlink(missing_ok=True)
        self._make_room(path)
        return path

    @contextlib.contextmanager
    def learning(self, key: str) -> Iterator[None]:
        """Hold the lock of a model's training, so that no other process trains it meanwhile.

        If no lock can be made, each process trains its own.

        Raises:
            Timeout: another process holds it.
        """
        lock = FileLock(self.folder / f"{key}.lock")
        try:
            lock.acquire(timeout=_WAIT_SECONDS)
        except Timeout:
            raise
        except OSError as error:
            self.tell(error)
        try:
            yield
        finally:
            lock.release()

    def _make_room(self, newest: Path) -> None:
        now, models = time.time(), []
        for path in self.folder.iterdir():
            with contextlib.suppress(OSError):  # another process may have just removed it
                about = path.stat()
                if path.suffix == ".npz" and path != newest:
                    models.append((about.st_mtime, about.st_size, path))
                elif path.suffix in (".part", ".lock") and (
                        now - about.st_mtime > _LEFT_OVER_SECONDS):
                    path.unlink()
        room = self.limit_bytes - newest.stat().st_size
        for _, size, path in sorted(models, reverse=True):
            room -= size
            if room < 0:
                with contextlib.suppress(OSError):
                    path.unlink()


@dataclass(frozen=True)
class LearntModel:
    """A reduced model and the full solutions that it was trained on.

    Attributes:
        was_known: It came from the cache.
    """

    reduced: ReducedModel
    snapshots: Snapshots
    was_known: bool


def learnt_model(model: BranchModel, grasp: Grasp, weights: np.ndarray,
                 control_young: np.ndarray, settings: ReducedSettings, *,
                 cache: ReducedCache | None, progress: Progress = SILENT) -> LearntModel:
    """Return the reduced model of a branch, from the cache or trained now and stored there.

    Where another process is learning the same one, this waits for it. Arguments as for
    :func:`limber.reduced.reduced_model.build_reduced`; without a ``cache`` nothing is kept.

    Raises:
        ConvergenceError: no training grasp has an equilibrium. InputError: other materials.
    """
    if cache is None:
        return LearntModel(*build_reduced(model, grasp, weights, control_young, settings,
                                          progress), was_known=False)
    key = model_key(model, grasp, weights, control_young, settings)
    while True:
        known = cache.load(key)
        if known is not None:
            return LearntModel(*known, was_known=True)
        try:
            with cache.learning(key):
                known = cache.load(key)  # the one that another process made
                if known is not None:
                    return LearntModel(*known, was_known=True)
                made = build_reduced(model, grasp, weights, control_young, settings, progress)
                try:
                    cache.store(key, *made)
                except OSError as error:
                    cache.tell(error)
                return LearntModel(*made, was_known=False)
        except Timeout:
            progress(0.0, "another process is training this model; waiting for it")
