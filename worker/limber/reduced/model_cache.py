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
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import platformdirs
from filelock import FileLock, Timeout

from limber.core.errors import InputError
from limber.core.files.reading import read_arrays
from limber.core.progress import SILENT, Progress
from limber.mechanics.grasp import Grasp
from limber.mechanics.materials.materials import RayleighDamping
from limber.mechanics.model import BranchModel
from limber.reduced.basis import Basis, make_basis
from limber.reduced.reduced_model import ReducedModel, ReducedSettings
from limber.reduced.strain_polynomial import StrainPolynomial, make_polynomial, reduced_mass
from limber.reduced.training import Snapshots, Trainer, sample_poses, sample_young

# A reduced model as a file of plain arrays.

FORMAT = 5


def write_model(model: ReducedModel, path: Path,
                beside: Mapping[str, np.ndarray] | None = None) -> None:
    """Write a model as plain arrays (npz, nothing pickled); ``beside`` goes into the file
    too, under names that begin with ``snapshot_``, which :func:`read_model` leaves alone."""
    arrays = {
        "format": FORMAT, "grasp_nodes": model.grasp.nodes, "grasp_weights": model.grasp.weights,
        "grasp_centre": model.grasp.centre, "grasp_mode": model.grasp.mode, "rest": model.rest,
        "columns": model.basis.columns, "lift_count": model.basis.lift_count,
        "states": model.basis.states, "captured": model.basis.captured, "reach": model.basis.reach,
        **{f"polynomial_{k}": v for k, v in vars(model.polynomial).items()},
        "load": model.load, "weight_stiffness": model.weight_stiffness, "mass": model.mass,
        "damping": [model.damping.mass, model.damping.stiffness],
        "control_young": model.control_young, "poses": model.poses,
        "training_young": model.training_young, "energies": model.energies,
        "young_spread": model.young_spread, "extent": model.extent,
        "error_names": list(model.error), "error_values": list(model.error.values())}
    with open(path, "wb") as stream:
        np.savez(stream, **arrays, **(beside or {}))


def read_model(path: Path) -> ReducedModel:
    """Read a model that :func:`write_model` wrote; InputError if it is none, or of another
    format."""
    arrays = {name: values for name, values in read_arrays(path, "a reduced model").items()
              if not name.startswith("snapshot_")}
    if int(arrays.get("format", -1)) != FORMAT:
        raise InputError(f"{path} has a different format.", "", "Build it again.")
    grasp = Grasp(arrays["grasp_nodes"], arrays["grasp_weights"], arrays["grasp_centre"],
                  "point" if str(arrays["grasp_mode"]) == "point" else "rigid")
    basis = Basis(arrays["columns"], int(arrays["lift_count"]), arrays["states"],
                  float(arrays["captured"]), arrays["reach"])
    linear, quadratic, by_lambda, by_mu = (
        arrays[f"polynomial_{name}"] for name in ("linear", "quadratic", "by_lambda", "by_mu"))
    polynomial = StrainPolynomial(linear, quadratic, by_lambda, by_mu,
                                  float(arrays["polynomial_poisson"]))
    error = dict(zip(arrays["error_names"].tolist(), arrays["error_values"].tolist(),
                     strict=True))
    return ReducedModel(
        grasp, arrays["rest"], basis, polynomial, arrays["load"], arrays["weight_stiffness"],
        arrays["mass"], RayleighDamping(*arrays["damping"]), arrays["control_young"],
        arrays["poses"], arrays["training_young"], arrays["energies"],
        float(arrays["young_spread"]), float(arrays["extent"]), error)


# Construction of a reduced model: full solutions at training grasps, and their span.

_DEFAULT = ReducedSettings()


def build_reduced(model: BranchModel, grasp: Grasp, weights: np.ndarray,
                  control_young: np.ndarray,
                  settings: ReducedSettings = _DEFAULT,
                  progress: Progress = SILENT) -> tuple[ReducedModel, Snapshots]:
    """Solve the full model (St. Venant-Kirchhoff) at training grasps and make the reduced one.
    ``weights`` [tet_count, K] lead from control points, with ``control_young`` [Pa], to tetrahedra.
    ConvergenceError if no grasp has an equilibrium, InputError for other materials."""
    training = settings.training
    rng = np.random.default_rng(training.seed)
    trainer = Trainer(model, grasp, weights, control_young,
                      young_tangents=training.young_spread > 1)
    poses = sample_poses(model, grasp, training.grasp_count, rng, training)
    young = sample_young(control_young, len(poses), rng, training.young_spread)
    snapshots = trainer.take(poses, young, vibration_every=training.vibration_every,
                             vibration_count=training.vibration_count,
                             progress=progress.part(0.0, 0.9))
    progress(0.9, "reducing", snapshots=len(snapshots))
    reduced = reduce_snapshots(model, grasp, weights, control_young, snapshots, settings)
    progress(1.0, "reduced model ready", size=reduced.size)
    return reduced, snapshots


def reduce_snapshots(model: BranchModel, grasp: Grasp, weights: np.ndarray,
                     control_young: np.ndarray, snapshots: Snapshots,
                     settings: ReducedSettings) -> ReducedModel:
    """Return the reduced model of given full solutions; arguments as in :func:`build_reduced`."""
    control_young = np.asarray(control_young, float)
    if not settings.vibration_count:
        snapshots = snapshots.without_vibrations()
    basis = make_basis(model, grasp, snapshots, settings.size,
                       settings.vibration_count if len(snapshots.vibrations) else 0)
    polynomial = make_polynomial(model, basis, weights, control_young, snapshots,
                                 settings.field_count)
    flat = basis.columns.reshape(basis.size, -1)
    spread = float(np.exp(np.abs(np.log(snapshots.young / control_young)).max()))
    weight = model.weight_stiffness
    carried = np.zeros((basis.size, basis.size)) if weight is None else flat @ np.array(
        [weight @ column for column in basis.columns]).reshape(basis.size, -1).T
    return ReducedModel(
        grasp, model.mesh.nodes, basis, polynomial, flat @ model.weight_force.ravel(), carried,
        reduced_mass(model, basis), model.damping, control_young, snapshots.poses,
        snapshots.young, snapshots.energy, max(spread, 1.0), model.extent)


def as_control_points(model: BranchModel) -> tuple[np.ndarray, np.ndarray]:
    """Return weights [tet_count, K] and moduli [K] [Pa] that give the model's Young's modulus. If
    the mesh's control points cannot, it becomes one region of which only the level can change."""
    from limber.mechanics.materials.materials import young_weights

    marks = model.mesh.point_data.get("control_point")
    if marks is not None and (marks >= 0).any():
        order = np.argsort(marks[marks >= 0])
        points = model.mesh.nodes[np.flatnonzero(marks >= 0)[order]]
        weights = young_weights(model.mesh, points)
        young = np.linalg.lstsq(weights, model.young, rcond=None)[0]
        if (young > 0).all() and np.abs(weights @ young / model.young - 1).max() < 1e-6:
            return weights, young
    level = float(model.young.mean())
    return (model.young / level)[:, None], np.array([level])


LIMIT_BYTES = 2 << 30
"""Largest size of all models of a folder: a dozen for a branch of some thousand tetrahedra."""
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
    """Reduced models in a folder, the least recently used removed beyond ``limit_bytes``; the one
    stored last stays. If the folder cannot be written, models are trained and not kept."""

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
        """Return a model and its full solutions; None without one. Damaged files go, with a
        warning."""
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
        """Hold the lock of a model's training; Timeout if another process holds it. If no lock can
        be made, each process trains its own."""
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
    """A reduced model and the full solutions that trained it; ``was_known``: from the cache."""

    reduced: ReducedModel
    snapshots: Snapshots
    was_known: bool


def learnt_model(model: BranchModel, grasp: Grasp, weights: np.ndarray,
                 control_young: np.ndarray, settings: ReducedSettings, *,
                 cache: ReducedCache | None, progress: Progress = SILENT) -> LearntModel:
    """Return the reduced model from the cache, or train and store it, where another process does so
    after waiting for that. Without a ``cache`` nothing is kept. Arguments and errors are those of
    :func:`build_reduced`."""
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
