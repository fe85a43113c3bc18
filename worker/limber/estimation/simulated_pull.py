"""Simulated pulls with a known Young's modulus and sensor noise, without a robot.

The truth is on another mesh than the fit: finer, swept along the axes, with the true geometry if
the branch was generated; or it is a rod that shares no code with the fit. The known truth is stored
in ``pull.toml`` under ``truth``, so that an estimate can be scored; no estimate reads it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import scipy

from limber.core.constants import GRAVITY
from limber.core.errors import InputError, Option, Text, WorkError
from limber.core.not_none import present
from limber.core.numerics.rigid import composed, rotated
from limber.core.progress import SILENT, Progress
from limber.estimation.forward.observed_path import MotionMade, MotionWanted, moved, seen_at
from limber.estimation.rod import Rod, RodMotion
from limber.estimation.settings import PullSpec
from limber.estimation.uncertainty.model_error import refined
from limber.geometry.cloud.camera import D455, Camera, write_camera
from limber.geometry.shape_samples import reshaped, sample_skeletons
from limber.geometry.skeleton.assumed_modulus import MOST_TURN, turn_by_weight
from limber.geometry.skeleton.skeleton import FRACTIONS, Skeleton, control_points
from limber.geometry.tets.tet_mesh import TetMesh, base_nodes
from limber.geometry.tets.tetrahedra import MeshSettings, mesh_branch
from limber.mechanics.loads.loaded_branch import hang
from limber.mechanics.materials.materials import RayleighDamping, young_weights
from limber.mechanics.model import BranchModel
from limber.perception.observe import write_depth
from limber.perception.simulated_camera import render_depth, with_noise
from limber.recordings import recording

# Simulated errors of a cell: drawn once, then applied to its recordings.


@dataclass
class CellErrors:
    """Errors of one cell that all recordings share: gripper's and camera's frame [m, rad] [3], a
    factor on force; ``calibration`` has their deviations."""

    calibration: recording.CalibrationEntry
    gripper_offset: np.ndarray
    gripper_turn: np.ndarray
    force_gain: float
    camera_offset: np.ndarray
    camera_turn: np.ndarray
    pivot: np.ndarray | None = None

    @classmethod
    def drawn(cls, calibration: recording.CalibrationEntry,
              rng: np.random.Generator) -> "CellErrors":
        """Draw the errors that remain after a calibration."""
        return cls(calibration, calibration.pose_sigma_m * rng.standard_normal(3),
                   calibration.pose_sigma_rad * rng.standard_normal(3),
                   1 + calibration.force_gain_sigma * rng.standard_normal(),
                   calibration.camera_sigma_m * rng.standard_normal(3),
                   calibration.camera_sigma_rad * rng.standard_normal(3))

    @property
    def truth(self) -> dict[str, Any]:
        """The drawn errors, for ``truth`` in ``pull.toml``."""
        return {"gripper_place_m": self.gripper_offset.tolist(),
                "gripper_turn_rad": self.gripper_turn.tolist(), "force_gain": self.force_gain,
                "camera_place_m": self.camera_offset.tolist(),
                "camera_turn_rad": self.camera_turn.tolist()}

    def recorded(self, pull: recording.Pull, rng: np.random.Generator) -> recording.Pull:
        """Record an exact pull with this cell and a zero and drift of its own, without noise. The
        gripper's frame turns about ``pivot`` [3], if none is set the first pull's grasp, the
        observer's about the centre of the points at rest."""
        known, times = self.calibration, pull.times
        wrenches = pull.wrenches.copy()
        wrenches[:, :3] = self.force_gain * wrenches[:, :3] + self._zero(times, rng)
        wrenches[:, 3:] += known.torque_bias_sigma_nm * rng.standard_normal(3)
        at = self.pivot = np.array(pull.entry.grasp.point_m if self.pivot is None else self.pivot)
        poses = pull.poses.copy()
        moved = rotated(self.gripper_turn, poses[:, :3] - at)
        poses[:, :3] = (at + self.gripper_offset + moved
                        + known.pose_noise_m * rng.standard_normal((len(times), 3)))
        poses[:, 3:] = composed(self.gripper_turn, poses[:, 3:])
        late = known.clock_sigma_s * rng.standard_normal()
        observations = pull.observations
        if observations is not None:
            observations = replace(observations, positions=self._seen(
                times, observations.positions, late))
        return replace(pull, entry=pull.entry.model_copy(update={"calibration": known}),
                       poses=poses, wrenches=wrenches, observations=observations)

    def _zero(self, times: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Zero of the force over a recording [N], shape [n, 3]; it drifts as a sensor warms up."""
        share = (times - times[0]) / (times[-1] - times[0])
        slowing = rng.uniform(0.3, 3.0)
        course = (1 - np.exp(-share / slowing)) / (1 - np.exp(-1 / slowing))
        return (self.calibration.force_bias_sigma_n * rng.standard_normal(3)
                + self.calibration.force_drift_sigma_n * rng.standard_normal(3) * course[:, None])

    def _seen(self, times: np.ndarray, positions: np.ndarray, late: float) -> np.ndarray:
        middle = positions[0].mean(axis=0)
        spline = scipy.interpolate.CubicSpline(times, positions)
        at = spline(np.clip(times + late, times[0], times[-1]))
        turned = rotated(self.camera_turn, (at - middle).reshape(-1, 3)).reshape(at.shape)
        return middle + turned + self.camera_offset


def marked_points(skeleton: Skeleton, fractions: Sequence[float],
                  shifts: np.ndarray | float) -> np.ndarray:
    """Return true positions [K, 3] [m] of points meant for control points, ``shifts`` [K] [m] along
    the branch from them."""
    length = skeleton.arc_length[skeleton.main_path()[-1]]
    return control_points(skeleton, tuple(np.clip(
        np.array(fractions) + shifts / length, 0.01, 0.99).tolist()))


BODY_LIMIT = 25_000
"""Most tetrahedra of a meshed body's truth: a finer one takes minutes per pull."""
SHAPE_TRIES = 8
DEFAULT_YOUNG_PA = (1.6e8, 1.0e8, 7.0e7, 4.0e7)
"""A gradient like that of the paper's branches, at the stiffness of young wood."""

_PULL_TURN = 2.0  # angle by which the direction of a pull turns [rad]: both bending axes are seen


@dataclass(frozen=True)
class TrueBranch:
    """The branch of a virtual pull. ``is_weightless`` overrides settings; ``is_assumed``: moduli
    are, as a scan has no pulls; ``is_meshed``: meshed directly, so perhaps not round; ``source``:
    digest [hex] of what the branch was made of, which draws its cell in every pull."""

    mesh: TetMesh
    skeleton: Skeleton
    control_points: np.ndarray
    fractions: tuple[float, ...]
    young: np.ndarray
    gravity: tuple[float, float, float] = GRAVITY
    is_weightless: bool = False
    is_assumed: bool = False
    is_meshed: bool = False
    source: str = ""

    def young_at(self, positions: np.ndarray) -> np.ndarray:
        """Return Young's modulus [Pa], shape [n], at positions [m], shape [n, 3]."""
        away = np.linalg.norm(positions[:, None] - self.control_points, axis=2)
        shares = 1 / np.maximum(away, 1e-9)**2
        return shares @ self.young / shares.sum(axis=1)


def true_branch(skeleton: Skeleton, settings: PullSpec, *,
                body: TetMesh | None = None, scan: np.ndarray | None = None,
                fractions: tuple[float, ...] = FRACTIONS,
                young: Sequence[float] = (),
                gravity: tuple[float, float, float] = GRAVITY, source: str = "") -> TrueBranch:
    """Return the branch of true axes, on a mesh of its own; the settings' moduli take precedence.

    Without any moduli they are assumed: :data:`DEFAULT_YOUNG_PA`, or as many times stiffer as the
    branch needs to carry itself.

    Args:
        body: Tetrahedra of a body that was meshed directly. It is then the truth, with each
            tetrahedron cut in eight if that stays small, instead of the round branch of its axes.
        scan: The points that the axes were fitted to [m], shape [n, 3]: the branch is then another
            one that fits them as well (:mod:`limber.geometry.shape_samples`).
        source: Digest [hex] of what the branch was made of; it draws that other shape.

    Raises:
        InputError: not one modulus per control point. WorkError: no other shape can be meshed.
    """
    if settings.young:
        young = settings.young
        if len(young) != len(fractions):
            raise InputError(f"{len(young)} moduli for {len(fractions)} control points.",
                             "Each control point needs one modulus.",
                             "Give ", Option("young"), " A,B,C,D.")
    if body is not None:
        mesh = refined(body) if 8 * body.tet_count <= BODY_LIMIT and body.is_quadratic else body
    else:
        # Reconstructed branches have six-sided sections four radii apart.
        mesh = mesh_branch(skeleton, MeshSettings(mesher="sweep", mesh_spacing=1.3)
                           ).mesh
    if scan is not None and body is None:
        skeleton, mesh = _another(skeleton, mesh, scan, _drawing(source, 2))
    mesh = mesh.with_data(point_data={"fixed": base_nodes(mesh, skeleton)})
    found = TrueBranch(mesh, skeleton, control_points(skeleton, fractions), fractions,
                       np.array(young if len(young) else DEFAULT_YOUNG_PA, float), gravity,
                       is_meshed=body is not None, source=source)
    turn = 0.0 if len(young) else turn_by_weight(
        skeleton, found.young_at(skeleton.nodes), settings.density, gravity)
    return replace(found, young=found.young * max(1.0, turn / MOST_TURN))


def _drawing(source: str, stream: int) -> np.random.Generator:
    """A generator that is the same in all pulls of a branch, whenever and in any order."""
    return np.random.default_rng([int(source or "0", 16), stream])


def _another(skeleton: Skeleton, mesh: TetMesh, scan: np.ndarray, rng: np.random.Generator,
             ) -> tuple[Skeleton, TetMesh]:
    """Axes and tetrahedra of a different branch that fits the scan as well."""
    for shape in sample_skeletons(skeleton, scan, SHAPE_TRIES, rng):
        moved = reshaped(mesh, skeleton, shape)
        if moved.volumes.min() > 0:
            return shape, moved
    raise WorkError(f"None of {SHAPE_TRIES} posterior samples of the shape can be pulled.",
                    "The scan is so uncertain that their tetrahedra are inverted.",
                    "Scan with less noise.")


def simulate_pull(truth: TrueBranch, name: str, settings: PullSpec, *,
                  progress: Progress = SILENT) -> tuple[recording.Pull, list[np.ndarray]]:
    """Pull the true branch and measure it; returns the pull and the true displacements [m].

    Raises:
        InputError: the settings contradict each other. WorkError: the pull is impossible.
    """
    rng = np.random.default_rng(settings.seed)
    model = _model(truth, settings, progress)
    is_weightless = not (model.gravity.any() and (settings.own_weight or model.prestress))
    entry = _entry(truth, settings, is_weightless)
    phase = rng.uniform(0, 2 * np.pi) if settings.phase is None else settings.phase
    requested = _requested(truth, settings, entry, phase)
    shifts, points = _marked(truth, settings)
    made: MotionMade | RodMotion
    if settings.model == "rod":
        made = _rod(truth, settings, is_weightless).pulled(requested, progress=progress)
        positions, displacements = made.seen(points), []
    else:
        grasp = recording.grasp_on(truth.mesh, entry.grasp)
        made = moved(model.gripped(grasp), grasp, requested, progress=progress)
        displacements = made.displacements
        positions = seen_at(points, truth.mesh, displacements)
    sizes = [float(np.linalg.norm(made.wrenches[:, part], axis=1).max())
             for part in (slice(0, 3), slice(3, 6))]
    wrenches, count, poses = made.wrenches.copy(), len(made.wrenches), made.poses
    if settings.calibration != recording.EXACT:
        exact = recording.Pull(name, entry, settings.times, poses, wrenches,
                     recording.Observations(settings.times, positions))
        entry, poses, wrenches, positions = _misread(exact, shifts, settings, truth)
    wrenches[:, :3] += settings.force_noise * sizes[0] * rng.standard_normal((count, 3))
    positions = positions + settings.position_noise * rng.standard_normal(positions.shape)
    stray = rng.random(positions.shape[:2]) < settings.outliers
    positions[stray] += 0.05 * rng.standard_normal((int(stray.sum()), 3))
    wrenches[:, 3:] += settings.torque_noise * sizes[1] * rng.standard_normal((count, 3))
    torque_sigma = max(settings.torque_noise, 2e-3) * sizes[1]
    entry = entry.model_copy(update={"sensor": recording.SensorEntry(
        position_sigma_m=max(settings.position_noise, 1e-4),
        force_sigma_n=max(settings.force_noise, 2e-3) * sizes[0],
        torque_sigma_nm=torque_sigma if settings.mode == "rigid" and torque_sigma > 0 else None)})
    observations = None if settings.camera else recording.Observations(settings.times, positions)
    return recording.Pull(name, entry, settings.times, poses, wrenches, observations), displacements


def _requested(truth: TrueBranch, settings: PullSpec, entry: recording.PullEntry,
               phase: float) -> MotionWanted:
    point = np.array(entry.grasp.point_m)
    arc = settings.grasp_fraction * truth.skeleton.arc_length[truth.skeleton.main_path()[-1]]
    return MotionWanted(
        kind=_kind(settings), point=point, axis=point - truth.skeleton.nodes[0],
        travel=settings.reach * arc, turn=_PULL_TURN, phase=phase, times=settings.times,
        weight=(settings.weight or 0.0) * np.array(truth.gravity)
        / np.linalg.norm(truth.gravity))


def _rod(truth: TrueBranch, settings: PullSpec, is_weightless: bool) -> Rod:
    """The true branch as a rod, with the same moduli between the control points. InputError if a
    rod cannot move as requested."""
    if settings.motion == "dynamic" or settings.camera or truth.is_meshed:
        raise InputError(
            Text(Option("model", "rod"), " was given with ", "a fast motion"
                 if settings.motion == "dynamic" else Option("camera") if settings.camera
                 else "a branch that was meshed directly", "."),
            "The rod is a round branch at rest, without a surface.",
            "Omit ", Option("model"), " rod.")

    gravity = np.zeros(3) if is_weightless else np.array(truth.gravity)
    return Rod.of(truth.skeleton, truth.young_at, settings.poisson, settings.density, gravity,
                  settings.grasp_fraction, as_scanned=not settings.own_weight)


def _marked(truth: TrueBranch, settings: PullSpec) -> tuple[np.ndarray, np.ndarray]:
    """Distances of the observed points along the branch from the control points [m], [K], and where
    they are [m], [K, 3]."""
    rng = np.random.default_rng([settings.seed, 4])
    shifts = settings.calibration.point_sigma_m * rng.standard_normal(len(truth.fractions))
    points = (marked_points(truth.skeleton, truth.fractions, shifts) if shifts.any()
              else truth.control_points)
    return shifts, points


def _misread(exact: recording.Pull, shifts: np.ndarray, settings: PullSpec, truth: TrueBranch,
             ) -> tuple[recording.PullEntry, np.ndarray, np.ndarray, np.ndarray]:
    """Return entry, poses, wrenches and positions as a cell with errors records them."""
    if settings.camera:
        raise InputError(Text(Option("camera"), " cannot be combined with errors of the cell."),
                         "Depth images are rendered by a camera whose position is known.",
                         "Omit ", Option("camera"), ", or the errors of the cell.")
    # All pulls of a branch are recorded in one cell, as the fit takes it.
    errors = CellErrors.drawn(settings.calibration, _drawing(truth.source, 3))
    errors.pivot = truth.skeleton.point_at(PullSpec().grasp_fraction)
    seen = errors.recorded(exact, np.random.default_rng([settings.seed, 5]))
    observed = present(seen.observations, "observed points")
    entry = seen.entry.model_copy(update={
        "truth": {**(exact.entry.truth or {}), "cell_errors": errors.truth | {
            "point_shifts_m": shifts.tolist()}}})
    return entry, seen.poses, seen.wrenches, observed.positions


def _model(truth: TrueBranch, settings: PullSpec,
           progress: Progress) -> BranchModel:
    weights = young_weights(truth.mesh, truth.control_points)
    has_weight = settings.gravity and not truth.is_weightless
    model = BranchModel(truth.mesh, young=weights @ truth.young, poisson=settings.poisson,
                        density=settings.density, gravity=truth.gravity if has_weight else None,
                        damping=RayleighDamping(*settings.damping))
    return model if settings.own_weight else hang(model, progress=progress).model


def _kind(settings: PullSpec,
          ) -> Literal["pull", "turned", "shake", "release", "weight"]:
    if settings.weight is not None:
        if settings.motion == "dynamic":
            raise InputError("A hung weight cannot be combined with a dynamic motion.",
                             "A hung weight is a slow, force-driven pull.",
                             "Omit ", Option("weight"), " or ", Option("motion"), " dynamic.")
        return "weight"
    if settings.motion == "dynamic":
        return "release" if settings.drive == "force" else "shake"
    return "turned" if settings.mode == "rigid" and settings.drive == "pose" else "pull"


def _entry(truth: TrueBranch, settings: PullSpec, is_weightless: bool) -> recording.PullEntry:
    point = truth.skeleton.point_at(settings.grasp_fraction)
    radius = truth.skeleton.radius_at(settings.grasp_fraction)
    known = {"young_pa": truth.young.tolist(), "poisson": settings.poisson,
             "density": settings.density, "damping": list(settings.damping),
             "fractions": list(truth.fractions),
             "control_points_m": truth.control_points.tolist(),
             "tet_count": truth.mesh.tet_count, "seed": settings.seed,
             "assumed": truth.is_assumed}
    return recording.PullEntry(
        observation="depth" if settings.camera else "markers",
        drive="force" if settings.weight is not None else settings.drive,
        motion=settings.motion, calibration=recording.EXACT,
        gravity_m_s2=truth.gravity if settings.own_weight and not is_weightless else None,
        weightless=is_weightless,
        grasp=recording.GraspEntry(point_m=tuple(map(float, point)), radius_m=float(1.3 * radius),
                         mode=settings.mode),
        rest_points_m=None if settings.camera else tuple(
            tuple(map(float, p)) for p in truth.control_points),
        source="limber virtual-pull", truth=known)


def write_depth_frames(folder: Path, truth: TrueBranch, pull: recording.Pull,
                       displacements: list[np.ndarray], settings: PullSpec) -> None:
    """Write simulated D455 depth images of a pull: ``depth/`` and ``camera.toml``."""
    camera = viewing(truth.mesh.nodes, displacements)
    write_camera(folder / "camera.toml", camera)
    (folder / "depth").mkdir(exist_ok=True)
    faces = truth.mesh.surface_faces()
    rng = np.random.default_rng([settings.seed, 1])
    for time, displacement in zip(pull.times, displacements, strict=True):
        depth = render_depth(camera, truth.mesh.nodes + displacement, faces)
        write_depth(folder / "depth" / f"{time:.6f}.png", with_noise(camera, depth, rng), camera)


def viewing(nodes: np.ndarray, displacements: list[np.ndarray], distance: float = 1.0) -> Camera:
    """Return a D455 that sees all of a motion from ``distance`` [m], across its main extent."""
    everything = np.vstack([nodes + moved for moved in displacements])
    middle = (everything.min(axis=0) + everything.max(axis=0)) / 2
    _, _, axes = np.linalg.svd(everything - middle, full_matrices=False)
    # The direction in which the motion spreads least, so that points do not hide each other.
    across = axes[2] * [1.0, 1.0, 0.0]
    if np.linalg.norm(across) < 0.3:
        across = np.array([0.0, -1.0, 0.0])
    across = across / np.linalg.norm(across)
    return D455.looking(eye=middle + distance * across, target=middle)
