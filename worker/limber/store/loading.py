"""The data that stages read from a branch folder, as values for the packages below.

The packages know no folder: all of a branch's mesh, masses, axes and pulls in a computation is
loaded here.
"""

import hashlib
import math
from collections.abc import Iterable
from dataclasses import replace
from typing import Annotated, Any, TypedDict, Unpack

import numpy as np
from pydantic import Field

from limber.core.alignment import Alignment
from limber.core.constants import FOUND_SKELETON, UNIT_METRES
from limber.core.errors import Command, InputError, Option, Text
from limber.core.files.reading import FileContent, read_json_as
from limber.core.progress import SILENT, Progress
from limber.estimation.estimate_file import read_estimate
from limber.estimation.estimated_branch import Subject, observed, subject_of
from limber.estimation.settings import EstimateSettings, FitSpec
from limber.geometry.io.skeletons import read_cylinders, read_skeleton, read_swc
from limber.geometry.settings import DENSITY_SIGMA, GIVEN_POISSON_SIGMA, POISSON
from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.tets.tet_mesh import TetMesh
from limber.mechanics.added_masses import HungTwig, PointMass
from limber.mechanics.loads.loaded_branch import LoadedBranch, NamedTarget, hang, target_masses
from limber.mechanics.materials.laws import MaterialLaw
from limber.mechanics.materials.materials import RayleighDamping
from limber.mechanics.model import DEFAULT_DAMPING, BranchModel
from limber.planning.field.grasp_model import GraspModel, grasp_model_of
from limber.recordings.recording import Pull, read_pull
from limber.recordings.sensor_checks import clean
from limber.store import Branch

TARGETS_FORMAT = 1
"""Version of ``targets.json``."""

_Coordinate = Annotated[float, Field(ge=-1e6, le=1e6)]
_Vector = tuple[_Coordinate, _Coordinate, _Coordinate]


class _Mass(FileContent):
    mass_kg: float = Field(ge=0)
    attached_m: _Vector
    centre_m: _Vector | None = None
    inertia_kg_m2: tuple[_Vector, _Vector, _Vector] | None = None


class _Target(FileContent):
    name: str
    position_m: _Vector
    mass_kg: float = Field(ge=0)


class _Targets(FileContent):
    format_version: int
    targets: list[_Target]


def load_mesh(branch: Branch) -> TetMesh:
    """Return the branch's tetrahedra; BranchFolderError if there is no mesh."""
    return TetMesh.read(branch.require("mesh.vtu", "reconstruct"))


def load_skeleton(branch: Branch) -> Skeleton:
    """Return the branch's axes, with their known uncertainty.

    Raises:
        BranchFolderError: there is no skeleton.
    """
    if branch.has("skeleton.csv"):
        return read_cylinders(branch.path("skeleton.csv"))
    return read_swc(branch.require("skeleton.swc", "reconstruct"))


def load_found_skeleton(branch: Branch, alignment: Alignment, unit: str) -> Skeleton:
    """Return the axes as reconstruct found them, before edits, in the frame of ``alignment`` [m].
    They are kept in ``unit``, that of the scan's file. BranchFolderError if they were not kept."""
    found = read_skeleton(branch.require(f"{FOUND_SKELETON}.csv", "reconstruct"),
                          scale=UNIT_METRES[unit])
    return found.moved(alignment.apply(found.nodes / alignment.scale))


def load_masses(branch: Branch) -> list[dict[str, Any]]:
    """Return the results of reconstruct outside the mesh: pruned twigs and leaves."""
    if not branch.has("point_masses.json"):
        return []
    found = read_json_as(branch.path("point_masses.json"), list[_Mass], "a list of masses")
    return [mass.model_dump(exclude_unset=True, exclude_none=True) for mass in found]


def load_point_masses(branch: Branch) -> tuple[PointMass, ...]:
    """Return the masses that hung on the scanned branch and are not in its mesh: twigs and leaves,
    as rigid bodies that move with their section, masses stated in a table, and targets."""
    return hung_masses(load_masses(branch), load_targets(branch))


def hung_masses(masses: Iterable[dict[str, Any]], targets: tuple[NamedTarget, ...],
                ) -> tuple[PointMass, ...]:
    """Return the point masses of pruned twigs and leaves, as reconstruct lists them, and
    targets."""
    return (*(_hung(mass) for mass in masses), *target_masses(targets))


def _hung(mass: dict[str, Any]) -> PointMass:
    if mass.get("kind") == "table":
        return PointMass(tuple(mass["attached_m"]), mass["mass_kg"])
    x, y, z = map(tuple, mass.get("inertia_kg_m2", np.zeros((3, 3)).tolist()))
    return HungTwig(tuple(mass.get("centre_m", mass["attached_m"])), mass["mass_kg"],
                    tuple(mass["attached_m"]), (x, y, z))


def load_targets(branch: Branch) -> tuple[NamedTarget, ...]:
    """Return the positions that `limber target` has named; InputError for a newer program's
    file."""
    if not branch.has("targets.json"):
        return ()
    known = read_json_as(branch.path("targets.json"), _Targets, "a list of targets")
    if known.format_version != TARGETS_FORMAT:
        raise InputError(f"{branch.folder}/targets.json has format {known.format_version}.",
                         f"This program supports format {TARGETS_FORMAT}.", "Update Limber.")
    return tuple(NamedTarget(t.name, t.position_m, t.mass_kg) for t in known.targets)


def load_grasp_point(branch: Branch) -> tuple[float, float, float] | None:
    """Return the position of the grasp that the mesh marks [m], None if unknown."""
    fraction = branch.made.settings.get("grasp_fraction") if branch.made else None
    if fraction is None or not branch.has("skeleton.swc"):
        return None
    x, y, z = map(float, load_skeleton(branch).point_at(float(fraction)))
    return x, y, z


class ModelOptions(TypedDict, total=False):
    """Options of a branch's model, as for BranchModel."""

    material: str | MaterialLaw
    damping: RayleighDamping


class Overrides(ModelOptions, total=False):
    """Parts of a branch's model that may replace those in its folder."""

    young: float | np.ndarray | None
    poisson: float | np.ndarray | None
    density: float | np.ndarray | None
    point_masses: Iterable[PointMass] | None


def load_branch(branch: Branch, *, gravity: bool = True, loaded: bool = False,
                progress: Progress = SILENT, **overrides: Unpack[Overrides]) -> LoadedBranch:
    """Return the branch for all computations: as it hangs, with targets and grasp.

    Args:
        gravity: Whether it has weight.
        loaded: Whether further weights are hung on it.
        progress: Warned if the branch cannot carry itself and its weight is ignored.
        overrides: As for :func:`load_model`.

    Raises:
        BranchFolderError: there is no mesh. InputError: it lacks material data, or is ``loaded``
            and too soft to carry itself.
    """
    model = load_model(branch, gravity=gravity, **overrides)
    if overrides.get("young") is None:
        warn_of_assumed_young(branch, model.young, progress)
    hanging = hang(model, load_targets(branch), loaded=loaded, progress=progress)
    return replace(hanging, grasp_point=load_grasp_point(branch))


def warn_of_assumed_young(branch: Branch, young: np.ndarray, progress: Progress) -> None:
    """Warn if Young's modulus in the mesh [Pa] is neither estimated nor stated."""
    made_by = branch.manifest.files["mesh.vtu"].stage
    made = branch.manifest.stages.get(made_by)
    if made_by in ("reconstruct", "mesh") and made and made.settings.get("young", young) is None:
        progress.warn(Text(
            f"Young's modulus is not known: {np.median(young):.2g} Pa is assumed, and forces, "
            "energies and strains are as uncertain as that. Estimate it (", Command("estimate"),
            "), or state it (", Command(made_by, Option("young")), ")."))


def known_damping(branch: Branch, progress: Progress = SILENT) -> RayleighDamping:
    """Return the damping from the last swing, else that of simulations, with a warning."""
    swings = [branch.manifest.stages[key] for key in ("swing", "vibration")
              if key in branch.manifest.stages]
    known = max(swings, key=lambda entry: entry.finished).result if swings else {}
    mass, stiffness = known.get("damping_mass_per_s", -1), known.get("damping_stiffness_s", -1)
    if all(isinstance(each, int | float) and each >= 0 for each in (mass, stiffness)):
        return RayleighDamping(float(mass), float(stiffness))
    progress.warn("No swing has been fitted, so the damping of simulations is used.")
    return DEFAULT_DAMPING


def stiffness_deviation(branch: Branch) -> float | None:
    """Relative standard deviation of E I, equal all along, by the last estimate, swing or ringing
    (these state only E); None if there is none. On the branch's own mesh, errors of radius and E
    cancel. InputError if ``estimate.json`` is damaged."""
    entries = {key: branch.manifest.stages[key] for key in ("estimate", "swing", "vibration")
               if key in branch.manifest.stages}
    last = max(entries, key=lambda key: entries[key].finished, default=None)
    if last in ("swing", "vibration"):
        interval = entries[last].result.get("young_interval_pa")
        if isinstance(interval, list) and len(interval) == 2 and all(
                isinstance(end, int | float) and end > 0 for end in interval):
            return abs(math.log(interval[1] / interval[0])) / (2 * 1.96)
    if not branch.has("estimate.json"):
        return None
    known = read_estimate(branch.path("estimate.json"))
    intervals = np.array(known.get("bending_stiffness_interval_nm2")
                         or known.get("young_interval_pa") or np.zeros((0, 2)), float)
    known_ones = intervals[np.isfinite(intervals).all(axis=1) & (intervals > 0).all(axis=1)]
    return (float(np.mean(np.log(known_ones[:, 1] / known_ones[:, 0]))) / (2 * 1.96)
            if len(known_ones) else None)


def load_model(branch: Branch, *, gravity: bool = True, young: float | np.ndarray | None = None,
               poisson: float | np.ndarray | None = None,
               density: float | np.ndarray | None = None,
               point_masses: Iterable[PointMass] | None = None,
               **options: Unpack[ModelOptions]) -> BranchModel:
    """Return the model of ``mesh.vtu`` as the unloaded shape (see :func:`load_branch`), with the
    scan's gravity and the masses that hang on it. Given values replace the folder's.
    BranchFolderError if there is no mesh, InputError if it lacks material data."""
    mesh = load_mesh(branch)

    def known(name: str, value: float | np.ndarray | None) -> float | np.ndarray:
        if value is None and name not in mesh.cell_data:
            raise InputError(f"{branch.folder}/mesh.vtu has no cell data {name!r}.",
                             "The material is unknown.", "Reconstruct again.")
        return mesh.cell_data[name] if value is None else value

    return BranchModel(
        mesh, young=known("young", young), poisson=known("poisson", poisson),
        density=known("density", density), gravity=branch.gravity if gravity else None,
        point_masses=load_point_masses(branch) if point_masses is None else point_masses,
        **options)


def load_grasp_model(branch: Branch, *, gravity: bool, progress: Progress = SILENT) -> GraspModel:
    """Return the data for planning, see :func:`limber.planning.field.grasp_model.grasp_model_of`.
    BranchFolderError if a file is missing, InputError if the mesh lacks material or grasp."""
    return grasp_model_of(load_branch(branch, gravity=gravity, progress=progress),
                          load_skeleton(branch))


def density_sigma(branch: Branch) -> float:
    """Return the relative standard deviation of the density with which the branch was made."""
    return (branch.made.settings if branch.made else {}).get("density_sigma", DENSITY_SIGMA)


def wood_digest(branch: Branch) -> dict[str, str]:
    """Return what a result depends on besides: the wood that the branch was made of, as stated."""
    made = branch.made.settings if branch.made else {}
    return {"wood": repr([made.get(name) for name in ("density", "density_sigma", "poisson")])}


def fit_spec(branch: Branch, settings: EstimateSettings) -> FitSpec:
    """Return what an estimate of the branch does; what Python gives whole stays as it is. It begins
    as the first one did: what that found is in the mesh, and no knowledge from before the pulls."""
    spec = FitSpec.of(settings)
    update = {} if isinstance(settings, FitSpec) else {"density_sigma": density_sigma(branch)}
    if update and branch.made and branch.made.settings.get("poisson", POISSON) != POISSON:
        update["poisson_sigma"] = GIVEN_POISSON_SIGMA
    if branch.has("mesh.vtu") and branch.manifest.files["mesh.vtu"].stage == "estimate":
        before = read_estimate(branch.path("estimate.json")).get("initial", {})
        update |= {name: value for name, value in before.items() if getattr(spec, name) is None}
    return spec.model_copy(update=update)


def load_subject(branch: Branch, settings: FitSpec) -> Subject:
    """Return the branch to estimate, with a uniform initial modulus. BranchFolderError if a file is
    missing, InputError if its moduli are not positive."""
    return subject_of(load_mesh(branch), load_skeleton(branch), load_point_masses(branch),
                      branch.gravity, settings)


def load_estimated_subject(branch: Branch, known: dict[str, Any], *, gravity: bool) -> Subject:
    """Return the branch as the estimate ``known``, content of ``estimate.json``, used it: its
    results have the same meaning. Without weight if that had to leave it out."""
    section = known.get("section", {})
    return load_subject(branch, FitSpec(
        fractions=tuple(known["fractions"]), gravity=gravity and not known.get("is_weightless"),
        field="open" if known.get("field_form") else "inverse_distance",
        also=("orders",) if known.get("orders") else (),
        pith_radius=section.get("pith_radius", 0.0),
        bark=(section["bark_thickness"], section["bark_modulus"]) if section else None))


def known_pulls(branch: Branch) -> list[str]:
    """Return the names of the branch's pulls, sorted."""
    return [name for name in branch.names("pulls") if branch.has(f"pulls/{name}/pull.toml")]


def pull_names(branch: Branch, settings: EstimateSettings) -> list[str]:
    """Return the pulls to use, checked; InputError without any, or if a requested one is
    missing."""
    known = known_pulls(branch)
    missing = [name for name in settings.pull if name not in known]
    if missing or not known:
        raise InputError(
            f"{branch.folder} has no pull {', '.join(missing)}." if missing
            else f"{branch.folder} has no pulls.",
            f"It has {', '.join(known)}." if known else "There is nothing to estimate from.",
            "Import one with ", Command("import-pull"), ", or simulate one with ",
            Command("virtual-pull"), ".")
    return list(settings.pull) or known


def pulls_digest(branch: Branch, names: list[str]) -> str:
    """Return a sha256 of all files of these pulls."""
    joined = "".join(f"{file} {branch.digest(file)}\n" for file in sorted(branch.manifest.files)
                     if any(file.startswith(f"pulls/{name}/") for name in names))
    return hashlib.sha256(joined.encode()).hexdigest()


def load_pulls(branch: Branch, names: list[str], subject: Subject, settings: FitSpec,
               progress: Progress = SILENT) -> list[Pull]:
    """Read and clean pulls; find control points in their images if there are no markers."""
    pulls = []
    for number, name in enumerate(names):
        folder = branch.path(f"pulls/{name}")
        pull = read_pull(folder)
        if pull.entry.observation in ("clouds", "depth"):
            pull = observed(folder, pull, subject, settings,
                            progress.part(number / len(names), (number + 1) / len(names)))
        pull = clean(pull)
        for message in pull.warnings:
            progress.warn(message)
        pulls.append(pull)
    return pulls
