"""The branch to estimate: its model and the control points of Young's modulus."""

from collections.abc import Mapping
from dataclasses import astuple, dataclass, replace
from pathlib import Path

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from limber.core.errors import Command, InputError, Option
from limber.core.json_values import stored
from limber.core.not_none import present
from limber.core.progress import SILENT, Progress
from limber.estimation import parameters
from limber.estimation.forward import forward_model as models
from limber.estimation.forward.observed_path import ObservedPathForward
from limber.estimation.forward.solved_pull import Lumping, QuasiStaticForward, uses_torque
from limber.estimation.settings import FitSpec
from limber.geometry.skeleton.radii.fit_kernels import on_cylinders
from limber.geometry.skeleton.skeleton import Skeleton, control_points
from limber.geometry.tets.tet_mesh import TetMesh
from limber.mechanics.added_masses import HungTwig, PointMass
from limber.mechanics.loads.loaded_branch import is_stable
from limber.mechanics.materials.materials import LayeredSection, RayleighDamping, young_weights
from limber.mechanics.model import BranchModel
from limber.mechanics.points import point_operator
from limber.recordings.recording import CalibrationEntry, Pull, PullEntry, calibration_of, grasp_on
from limber.recordings.synchronisation import Frames, frames_of

MODEL_YOUNG_PA = 1e8
"""Modulus of a model before its values are known: fixed, so that none is in a result's rounding."""


@dataclass(frozen=True)
class Subject:
    """The branch to estimate.

    Attributes:
        mesh: Its tetrahedra.
        skeleton: Its axes.
        control_points: [m], shape [K, 3].
        weights: Map Young's modulus from the control points to the tetrahedra, [tet_count, K]; of
            a layered section that of the wood to the equivalent one.
        model: The model with the initial values.
        start: The initial values.
        field: Interpolation prior between the control points. None: the weights interpolate.
        lumping: What of the branch is not in the mesh. None: all is.
    """

    mesh: TetMesh
    skeleton: Skeleton
    control_points: np.ndarray
    weights: np.ndarray
    model: BranchModel
    start: parameters.Values
    field: parameters.YoungField | None = None
    lumping: Lumping | None = None

    def young(self, values: parameters.Values) -> np.ndarray:
        """Young's modulus of the tetrahedra [Pa], shape [tet_count]."""
        return (self.field or parameters.YoungField(self.weights)).young(values)

    @property
    def hangs(self) -> bool:
        """Whether its weight acts in the scanned shape."""
        return self.model.prestress is not None and bool(self.model.gravity.any())

    def carries_itself(self, values: parameters.Values) -> bool:
        """Whether it is stable in the scanned shape under its weight, with these values."""
        return is_stable(self.model.with_parameters(
            young=self.young(values), poisson=values.poisson, density=values.density))

    def without_weight(self) -> "Subject":
        """Return the same branch without weight."""
        return replace(self, model=self.model.with_parameters(gravity=(0.0, 0.0, 0.0)))


# Twigs that no force and no marker reaches: rigid bodies on their feet.
#
# They bear nothing but their own weight. Their foot, which stiffens the branch that carries them,
# stays meshed; the rest acts by its weight only, exact for a rotation of any size.

FOOT = 4.0
"""Length of twig that stays meshed beyond the branch's surface, over the twig's radius. Of seven
scanned branches the response changed by at most 0.2 %; with 2 by 2 %, with 1 by 5 %.
"""
WORTH = 0.15
"""Least part of the tetrahedra that has to go."""
LUMPED_ERROR = 5e-3
"""Change of the response to the gripper's forces, relative to it, above which nothing is lumped."""


def lumped(whole: Subject, pulls: list[Pull], settings: FitSpec) -> Subject:
    """Return the branch with rigid twigs where no pull's gripper and no observed point is, if the
    pulls cannot tell the difference."""
    if "orders" in settings.also or any(
            pull.entry.motion != "quasi_static" or pull.entry.gravity_m_s2 is not None
            for pull in pulls):
        return whole
    touched = np.vstack([whole.control_points, *(
        np.vstack([pull.entry.grasp.point_m, _rest_points(pull.entry, whole)]) for pull in pulls)])
    kept, twig = _reached(whole.mesh, whole.skeleton, touched)
    if np.mean(~kept) < WORTH:
        return whole
    mesh = _part(whole.mesh, kept)
    weights, field, model = whole.weights[kept], whole.field, whole.model
    if field is not None:
        field = field.on(kept)
    weight, twigs = None, _twigs(whole, twig)
    bare = BranchModel(mesh, young=MODEL_YOUNG_PA, poisson=whole.start.poisson,
                       density=whole.start.density, gravity=tuple(model.gravity),
                       point_masses=model.point_masses)
    if model.prestress is not None:
        bare = bare.as_scanned()
        hung = bare.without_point_masses().with_point_masses(twigs).as_scanned()
        weight = present(present(hung.prestress, "prestress").added, "weight of twigs")
        known = present(bare.prestress, "prestress")
        bare.prestress = replace(known, own=known.own + weight)
    error = max(_response_change(model, bare, pull, _rest_points(pull.entry, whole))
                for pull in pulls)
    if error > LUMPED_ERROR:
        return whole
    return replace(whole, mesh=mesh, weights=weights, field=field, model=bare,
                   lumping=Lumping(error, weight, twigs))


def _reached(mesh: TetMesh, skeleton: Skeleton, points: np.ndarray,
             ) -> tuple[np.ndarray, np.ndarray]:
    """Which tetrahedra stay [tet_count], and each one's fork, a node of the skeleton; -1: stays."""
    stays = np.zeros(skeleton.node_count, bool)
    stays[skeleton.main_path()] = True
    for node in cKDTree(skeleton.nodes).query(points)[1]:
        while node >= 0 and not stays[node]:
            stays[node] = True
            node = skeleton.parent[node]
    fork = np.arange(skeleton.node_count)
    for node in np.flatnonzero(~stays):
        fork[node] = fork[skeleton.parent[node]]
    low, high, share, _ = on_cylinders(skeleton, mesh.centroids)
    along = (1 - share) * skeleton.arc_length[low] + share * skeleton.arc_length[high]
    at = fork[high]
    beyond = along - skeleton.arc_length[at] - skeleton.radius[at]
    kept = stays[high] | (beyond < FOOT * skeleton.radius[high])
    # What no chain of faces joins to the base would move freely, or turn about an edge.
    faces = np.sort(mesh.tets[kept][:, [[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]]], axis=2)
    number = np.unique(faces.reshape(-1, 3), axis=0, return_inverse=True)[1].ravel()
    links = sparse.csr_matrix((np.ones(len(number)), (np.arange(len(number)) // 4, number)))
    _, piece = connected_components(links @ links.T, directed=False)
    on_base = mesh.point_data["fixed"].astype(bool)[faces].all(axis=2).any(axis=1)
    kept[kept] = np.isin(piece, piece[on_base])
    return kept, np.where(kept, -1, at)


def _part(mesh: TetMesh, kept: np.ndarray) -> TetMesh:
    used, tets = np.unique(mesh.tets[kept], return_inverse=True)
    return TetMesh(mesh.nodes[used], tets.reshape(-1, mesh.tets.shape[1]),
                   {name: values[kept] for name, values in mesh.cell_data.items()},
                   {name: values[used] for name, values in mesh.point_data.items()})


def _twigs(whole: Subject, twig: np.ndarray) -> list[HungTwig]:
    """The tetrahedra of each fork as one rigid body."""
    centres, masses = whole.mesh.centroids, whole.start.density * np.abs(whole.mesh.volumes)
    found = []
    for fork in np.unique(twig[twig >= 0]):
        own = twig == fork
        mass = float(masses[own].sum())
        centre = masses[own] @ centres[own] / mass
        # Statics need no inertia.
        found.append(HungTwig(tuple(centre), mass, tuple(whole.skeleton.nodes[fork]),
                              ((0.0, 0.0, 0.0),) * 3))
    return found


def _response_change(whole: BranchModel, part: BranchModel, pull: Pull, points: np.ndarray,
                     ) -> float:
    """Relative change of the response of grasp and points at rest to forces on the grasp."""
    seen = []
    for model in (whole, part):
        plain = model.with_parameters(young=float(np.mean(model.young)), gravity=(0.0, 0.0, 0.0))
        grasp, rest = grasp_on(model.mesh, pull.entry.grasp), np.zeros_like(model.mesh.nodes)
        moved = models.compliance(plain, rest, models.nodal_loads(
            grasp, pull.entry.grasp, np.zeros(6), model.mesh.nodes, 3))
        operator = point_operator(model.mesh, np.vstack([points, pull.entry.grasp.point_m]))
        seen.append(np.array([operator @ each.ravel() for each in moved]))
    return float(np.linalg.norm(seen[1] - seen[0]) / np.linalg.norm(seen[0]))


def subject_of(mesh: TetMesh, skeleton: Skeleton, masses: tuple[PointMass, ...],
               gravity: tuple[float, float, float], settings: FitSpec) -> Subject:
    """Return the branch of a mesh, its axes and its point masses, with uniform initial moduli.

    Its rest shape is prestressed by gravity: the scanned shape holds for every Young's modulus.

    Raises:
        InputError: an initial modulus of the mesh is not positive.
    """
    points = control_points(skeleton, settings.initial_fractions)
    wrong = np.flatnonzero(~(mesh.cell_data["young"] > 0))
    if len(wrong) and settings.young is None:
        raise InputError(f"Young's modulus is {mesh.cell_data['young'][wrong[0]]:g} Pa in "
                         f"tetrahedron {wrong[0]} of mesh.vtu.", "The initial modulus must be "
                         "positive.", "Correct the mesh, or make the branch again with ",
                         Option("young"), ".")
    young = settings.young or stored(float(np.exp(np.mean(np.log(mesh.cell_data["young"])))))
    poisson = _or_mean(settings.poisson, mesh.cell_data["poisson"])
    density = _or_mean(settings.density, mesh.cell_data["density"])
    model = BranchModel(mesh, young=MODEL_YOUNG_PA, poisson=poisson, density=density,
                        gravity=gravity if settings.gravity else None, point_masses=masses)
    model = model.as_scanned() if settings.gravity else model
    start = parameters.Values(np.full(len(points), young), poisson, density,
                              astuple(RayleighDamping()))
    factor = LayeredSection(**settings.section).on(mesh, skeleton) if settings.section else 1.0
    weights = np.reshape(factor, (-1, 1)) * young_weights(mesh, points)
    field = None
    if settings.field == "open" and settings.method == "gauss-newton":
        field = parameters.open_field(mesh, skeleton, weights, settings.initial_fractions,
                           log_factor=np.log(factor), by_order="orders" in settings.also)
    return Subject(mesh, skeleton, points, weights, model, start, field)


def observed(folder: Path, pull: Pull, subject: Subject, settings: FitSpec,
             progress: Progress = SILENT) -> Pull:
    """Return a pull of images with the control points that are found in them."""
    from limber.perception.observe import observe

    observations, warnings = observe(folder, pull, subject.skeleton, settings.initial_fractions,
                                     progress=progress)
    return replace(pull, observations=observations).warned(*warnings)


def _or_mean(value: float | None, field: np.ndarray) -> float:
    # In the digits that files keep: an estimate done again begins with the same.
    return stored(float(np.mean(field))) if value is None else value


# Prepare a fit: forward simulations and free parameters of a branch and its pulls.

FREE_FRAME_M, FREE_FRAME_RAD = 0.1, 0.3
"""Standard deviations of the observer's frame if it is fitted freely (--free-frame)."""
NECK = 0.5
"""Radius over a larger one farther out that is named: a sixteenth of the stiffness."""


def tell_doubts(pulls: list[Pull], subject: Subject, progress: Progress) -> None:
    """Warn before a fit of what already speaks against the recordings or the reconstruction."""
    for pull in pulls:
        frames = frames_of(pull)
        for message in frames.warnings:
            progress.warn(message)
        off = _off_at_rest(pull, frames, _rest_points(pull.entry, subject))
        if off is not None and np.nanmax(off) > 5e-3 + 5 * pull.entry.sensor.position_sigma_m:
            progress.warn(
                f"{pull.name}: at rest, the observed points are up to {np.nanmax(off) * 1e3:.0f} "
                "mm away from their positions on this branch. Possible causes are a scan whose tip "
                "is short, another branch, another frame of reference, or another order of the "
                "markers.")
    for sentence in neck(subject.skeleton):
        progress.warn(f"{sentence} If the branch is not so thin there, the moduli come out wrong. "
                      "Correct the skeleton (", Command("skeleton"), "), or scan from more sides.")


def neck(skeleton: Skeleton) -> list[str]:
    """A sentence if the main path is much thinner somewhere than farther out."""
    path = skeleton.main_path()
    radius, along = skeleton.radius[path], skeleton.arc_length[path]
    beyond = np.maximum.accumulate(radius[::-1])[::-1]
    thin = int(np.argmin(radius / beyond))
    if radius[thin] > NECK * beyond[thin]:
        return []
    return [f"The reconstructed branch has a radius of {1e3 * radius[thin]:.1f} mm at "
            f"{1e3 * along[thin]:.0f} mm from its base, but {1e3 * beyond[thin]:.1f} mm farther "
            "out. Its stiffness goes with the fourth power of the radius."]


def forwards_of(pulls: list[Pull], subject: Subject, settings: FitSpec,
                shifts: Mapping[str, np.ndarray] | None = None) -> list[models.Forward]:
    """Make each pull's simulation; by name, ``shifts`` [m] are how much farther along the branch
    points are than stated. InputError if nothing is measured, or observed points differ."""
    forwards = []
    for pull in pulls:
        frames = frames_of(pull)
        entry = _with_overrides(pull.entry, frames, settings)
        rest = _rest_points(entry, subject)
        if frames.positions.shape[1] not in (0, len(rest)):
            raise InputError(f"{pull.name} observes {frames.positions.shape[1]} points, but "
                             f"{len(rest)} rest positions are known.", "Each observed point needs "
                             "a rest position.", "Give rest_points_m in pull.toml, or one value "
                             "of ", Option("fractions"), " for each marker.")
        if not frames.positions.shape[1]:
            raise InputError(f"{pull.name} has nothing that was seen of the branch, only what the "
                             "gripper did.", "An estimate compares how points of the branch moved.",
                             "Import it with the markers, depth images or clouds of the same time, "
                             "or name other pulls with ", Option("pull"), ".")
        _off_at_rest(pull, frames, rest)
        moved = (shifts or {}).get(pull.name)
        if moved is not None:
            rest = rest + moved[:, None] * models.PointDirections.at(subject.mesh, rest).rest
        forward = _forward(pull.name, entry, frames, rest, subject, settings)
        forward.skeleton = subject.skeleton
        if isinstance(forward, QuasiStaticForward):
            forward.lumping = subject.lumping
        if moved is not None:
            forward.point_shifts = moved
        forwards.append(forward)
    return forwards


def require_scale_in_principle(forwards: list[models.Forward]) -> None:
    """Reject pulls that cannot determine the scale of Young's modulus. InputError if all pulls are
    slow and pose-driven, without gravity or measured force."""
    for forward in forwards:
        entry = forward.entry
        if forward.uses_force or entry.drive == "force" or entry.motion == "dynamic" or (
                entry.gravity_m_s2 is not None):
            return
    raise InputError(
        "No pull has a measured force, gravity or inertia.",
        "A branch that moves slowly to prescribed poses takes the same shape whether it is soft "
        "or stiff. Only the ratios of Young's modulus along the branch can be determined. A fit "
        "would look perfect with every modulus wrong.",
        "Record the gripper's force, or let gravity or inertia act (gravity_m_s2 or motion in "
        "pull.toml).")


def _forward(name: str, entry: PullEntry, frames: Frames, rest: np.ndarray, subject: Subject,
             settings: FitSpec) -> models.Forward:
    if entry.motion == "swing":
        raise InputError(f"{name} is a free swing: no gripper holds the branch.",
                         "Its release, load and damping are fitted together over time.",
                         "Use ", Command("swing", Option("pull", name)), ", or name other pulls "
                         "with ", Option("pull"), ".")
    if entry.motion == "dynamic":
        from limber.estimation.forward.solved_pull import DynamicForward

        return DynamicForward(name, subject.model, subject.weights, entry, frames, rest,
                              field=subject.field)
    kind = ObservedPathForward if observes_path(entry, frames, settings) else QuasiStaticForward
    return kind(name, subject.model, subject.weights, entry, frames, rest,
                key_count=settings.key_frames, field=subject.field)


def observes_path(entry: PullEntry, frames: Frames, settings: FitSpec) -> bool:
    """Whether a slow pull's force drives and the recorded path is observed: the force (clamped: and
    torque) is measured, and the gripper's frame may err. Else the path drives as exact."""
    measured = np.isfinite(frames.wrenches[:, :3]).all(axis=1)
    known = calibration_of(entry)
    return (entry.drive == "pose" and settings.drive is None
            and bool(measured.mean() > 0.8)
            and (known.pose_sigma_m > 0 or known.pose_sigma_rad > 0)
            and (entry.grasp.mode == "point" or uses_torque(entry, frames)))


def parameter_space(subject: Subject, forwards: list[models.Forward], settings: FitSpec,
                    ) -> parameters.ParameterSpace:
    """Return the free parameters: Poisson's ratio, density if weight or inertia acts, and the
    field's form within their priors; requested ones (``--also``) without a prior."""
    fitted = {name: part in settings.also for name, part in (
        (parameters.BULK, "poisson"), ("density", "density"), ("alpha", "damping"),
        ("beta", "damping"))}
    chosen = {name for name, is_fitted in fitted.items() if is_fitted}
    form = subject.field.names if subject.field is not None else ()
    priors = [(name, 0.0, 1.0) for name in form]
    if settings.method == "gauss-newton":
        weighs = any(forward.is_dynamic or models.under_its_weight(
            subject.model, forward.entry).gravity.any() for forward in forwards)
        if settings.poisson_sigma > 0 and parameters.BULK not in chosen:
            priors.append((parameters.BULK, *parameters.bulk_prior(
                subject.start.poisson, settings.poisson_sigma)))
        if settings.density_sigma > 0 and "density" not in chosen and weighs:
            priors.append(("density", float(np.log(subject.start.density)),
                           settings.density_sigma))
    free = chosen | {name for name, _, _ in priors}
    extra = (*form, *(name for name in fitted if name in free))
    return parameters.ParameterSpace(subject.start, tuple(range(len(subject.start.young))), extra,
                          priors=tuple(priors))


def _with_overrides(entry: PullEntry, frames: Frames, settings: FitSpec) -> PullEntry:
    overrides = {"drive": settings.drive, "motion": settings.motion,
                 "calibration": _with_free_errors(entry, frames, settings)}
    return entry.model_copy(update={k: v for k, v in overrides.items() if v is not None})


def _with_free_errors(entry: PullEntry, frames: Frames, settings: FitSpec,
                      ) -> CalibrationEntry | None:
    """Return the pull's calibration; of what is not calibrated at all, nothing is known."""
    known = calibration_of(entry)
    free: dict[str, float] = {}
    if "frame" in settings.also:
        free |= {"camera_sigma_m": max(known.camera_sigma_m, FREE_FRAME_M),
                 "camera_sigma_rad": max(known.camera_sigma_rad, FREE_FRAME_RAD)}
    force = np.linalg.norm(frames.wrenches[:, :3], axis=1)
    if not entry.sensor.tared and np.isfinite(force).any():
        free |= {"force_bias_sigma_n": max(known.force_bias_sigma_n, float(np.nanmax(force)))}
    return known.model_copy(update=free) if free else None


def _rest_points(entry: PullEntry, subject: Subject) -> np.ndarray:
    return subject.control_points if entry.rest_points_m is None else np.array(entry.rest_points_m)


def _off_at_rest(pull: Pull, frames: Frames, rest: np.ndarray) -> np.ndarray | None:
    """Distance of each observed point at rest from its position on the branch [m]; None: unknown.
    InputError if all of them are farther away than the branch is long."""
    at_rest = np.linalg.norm(frames.poses[:, :3] - pull.entry.grasp.point_m, axis=1) < 2e-3
    seen = frames.positions[at_rest]
    if seen.shape[1:2] != (len(rest),) or pull.entry.gravity_m_s2 is not None or (
            not np.isfinite(seen).any()):
        return None
    off = np.linalg.norm(np.nanmedian(seen, axis=0) - rest, axis=1)
    size = float(np.linalg.norm(np.ptp(np.vstack([rest, pull.entry.grasp.point_m]), axis=0)))
    if np.nanmin(off) > max(2 * size, 0.1):
        raise InputError(f"{pull.name}: at rest, the observed points are {np.nanmin(off):.3g} to "
                         f"{np.nanmax(off):.3g} m away from their positions on this branch, which "
                         f"is about {size:.2g} m long.", "The recording uses another unit or "
                         "another frame of reference.", "Import it with ", Option("unit"), ", or "
                         "with ", Option("nominal"), " (the positions of the markers on the "
                         "branch).")
    return off
