"""The branch to estimate: its model and the control points of Young's modulus."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from limber.core.errors import InputError
from limber.core.progress import SILENT, Progress
from limber.estimation.interpolation_prior import YoungField, open_field
from limber.estimation.parameters import Values
from limber.estimation.settings import EstimateSettings
from limber.geometry.skeleton.control_points import control_points
from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.tets.tet_mesh import TetMesh
from limber.mechanics.added_masses import PointMass
from limber.mechanics.loads.loaded_branch import is_stable
from limber.mechanics.materials.layered_section import LayeredSection
from limber.mechanics.materials.materials import RayleighDamping
from limber.mechanics.materials.young_field import young_weights
from limber.mechanics.model import BranchModel
from limber.recordings.recording import Pull


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
    """

    mesh: TetMesh
    skeleton: Skeleton
    control_points: np.ndarray
    weights: np.ndarray
    model: BranchModel
    start: Values
    field: YoungField | None = None

    def young(self, values: Values) -> np.ndarray:
        """Young's modulus of the tetrahedra [Pa], shape [tet_count]."""
        return (self.field or YoungField(self.weights)).young(values)

    @property
    def hangs(self) -> bool:
        """Whether its weight acts in the scanned shape."""
        return self.model.prestress is not None and bool(self.model.gravity.any())

    def carries_itself(self, values: Values) -> bool:
        """Whether it is stable in the scanned shape under its weight, with these values."""
        return is_stable(self.model.with_parameters(
            young=self.young(values), poisson=values.poisson, density=values.density))

    def without_weight(self) -> "Subject":
        """Return the same branch without weight."""
        return replace(self, model=self.model.with_parameters(gravity=(0.0, 0.0, 0.0)))


def subject_of(mesh: TetMesh, skeleton: Skeleton, masses: tuple[PointMass, ...],
               gravity: tuple[float, float, float], settings: EstimateSettings) -> Subject:
    """Return the branch of a mesh, its axes and its point masses, with uniform initial moduli.

    Its rest shape is prestressed by gravity: the scanned shape holds for every Young's modulus.

    Raises:
        InputError: an initial modulus of the mesh is not positive.
    """
    points = control_points(skeleton, settings.initial_fractions)
    wrong = np.flatnonzero(~(mesh.cell_data["young"] > 0))
    if len(wrong) and settings.young is None:
        raise InputError(
            f"Young's modulus is {mesh.cell_data['young'][wrong[0]]:g} Pa in tetrahedron "
            f"{wrong[0]} of mesh.vtu.", "The initial modulus must be positive.",
            "Give --young, or correct the mesh.")
    young = settings.young or float(np.exp(np.mean(np.log(mesh.cell_data["young"]))))
    poisson = _or_mean(settings.poisson, mesh.cell_data["poisson"])
    density = _or_mean(settings.density, mesh.cell_data["density"])
    damping = RayleighDamping()
    model = BranchModel(mesh, young=young, poisson=poisson, density=density,
                        gravity=gravity if settings.gravity else None, point_masses=masses)
    model = model.as_scanned() if settings.gravity else model
    start = Values(np.full(len(points), young), poisson, density,
                   (damping.mass, damping.stiffness))
    factor = LayeredSection(**settings.section).on(mesh, skeleton) if settings.section else 1.0
    weights = np.reshape(factor, (-1, 1)) * young_weights(mesh, points)
    field = None
    if settings.field == "open" and settings.forward == "full" and (
            settings.method == "gauss-newton"):
        field = open_field(mesh, skeleton, weights, settings.initial_fractions,
                           log_factor=np.log(factor), by_order=settings.orders)
    return Subject(mesh, skeleton, points, weights, model, start, field)


def observed(folder: Path, pull: Pull, subject: Subject, settings: EstimateSettings,
             progress: Progress = SILENT) -> Pull:
    """Return a pull of images with the control points that are found in them."""
    from limber.perception.observe import observe

    observations, warnings = observe(folder, pull, subject.skeleton, settings.initial_fractions,
                                     progress=progress)
    return replace(pull, observations=observations).warned(*warnings)


def _or_mean(value: float | None, field: np.ndarray) -> float:
    return float(np.mean(field)) if value is None else value
