"""Exact derivatives of displacements and reactions to the parameters.

The internal force is linear in both Lamé coefficients, so its explicit derivative to any material
parameter is the same kernel with other coefficients. The displacement's derivative solves the
tangent equations at the converged state. If the factor is that of a nearby matrix, each solve is
refined with the exact directional derivative of the force.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from limber.core.errors import InputError
from limber.mechanics.grasp import Grasp
from limber.mechanics.linear.equations import Tangent, Viscous
from limber.mechanics.materials.materials import lame_by_bulk
from limber.mechanics.model import BranchModel, MotionState, product_with
from limber.mechanics.statics.result import StaticResult

PARAMETERS = ("log_young", "log_bulk_over_shear", "log_density", "damping_mass",
              "damping_stiffness")
"""Parameters for derivatives. ``log_young`` is one column for each column of the weights."""

_REFINEMENTS = 12
"""Most refinements of a solve: an upper bound, refinement ends at round-off."""


@dataclass(frozen=True)
class ParameterSet:
    """The requested derivatives.

    Attributes:
        names: Names from PARAMETERS.
        weights: Young's modulus of the tetrahedra is ``weights @ young_at_control_points``,
            shape [tet_count, K]; None: one factor on the whole field.
        control_young: Young's modulus at the control points [Pa], shape [K]; default: least-squares
            fit to the model's field.
        shares: Instead of both: derivative of log E of the tetrahedra to each parameter of the
            field, shape [K, tet_count].
    """

    names: tuple[str, ...] = ("log_young",)
    weights: np.ndarray | None = None
    control_young: np.ndarray | None = None
    shares: np.ndarray | None = None

    def labels(self) -> list[str]:
        """Return one name for each column of the derivatives."""
        count = (len(self.shares) if self.shares is not None
                 else 1 if self.weights is None else self.weights.shape[1])
        return [label for name in self.names
                for label in ([f"log_young_{k}" for k in range(count)]
                              if name == "log_young" else [name])]


@dataclass(frozen=True)
class StaticSensitivities:
    """Derivatives of a static state.

    Attributes:
        labels: Name of each of the p columns.
        displacement: [m per parameter], shape [node_count, 3, p].
        reaction_force: Force of the gripper on the branch [N per parameter], shape [3, p], or
            [grasps, 3, p] for several.
        strain_energy: Including that of a carried weight [J per parameter], shape [p].
    """

    labels: list[str]
    displacement: np.ndarray
    reaction_force: np.ndarray
    strain_energy: np.ndarray


def static_sensitivities(model: BranchModel, result: StaticResult,
                         grasp: Grasp | Sequence[Grasp] | None, weights: np.ndarray | None,
                         parameters: Sequence[str] = ("log_young",), *, is_held: bool = True,
                         control_young: np.ndarray | None = None,
                         shares: np.ndarray | None = None) -> StaticSensitivities:
    """Differentiate a converged static state.

    Args:
        grasp: The grasp of the solve.
        weights, control_young, shares: See :class:`ParameterSet`.
        parameters: Names from PARAMETERS; the derivatives to damping are 0.
        is_held: Whether the grasp was held at a pose; False for a force.
    """
    parameter_set = ParameterSet(checked_names(parameters), weights, control_young, shares)
    grasps = [] if grasp is None else [grasp] if isinstance(grasp, Grasp) else list(grasp)
    equations = model.equations(grasps if is_held else ())
    u = result.displacement
    tangent = equations.exact_tangent(model, u)
    explicit = explicit_forces(model, parameter_set, u)

    def force(direction: np.ndarray) -> np.ndarray:
        return model.tangent_times(u, direction)

    # A tangent factorised at this state needs no refinement.
    columns = (tangent.solve_all([-partial for partial in explicit])
               if tangent.is_positive_definite
               else [refined_solve(tangent, force, -partial) for partial in explicit])
    internal, forces, energies = model.internal(u), [], []
    for partial, change in zip(explicit, columns, strict=True):
        forces.append(reactions(grasps, partial + force(change)) if is_held
                      else np.zeros((len(grasps), 3)))
        energies.append(float((internal.force * change).sum()))
    energies = np.array(energies) + explicit_energies(model, parameter_set, u)
    reaction = np.stack(forces, axis=-1) if grasps else np.zeros((1, 3, len(columns)))
    if isinstance(grasp, Grasp) or grasp is None:
        reaction = reaction[0]
    return StaticSensitivities(parameter_set.labels(), np.stack(columns, axis=-1), reaction,
                               energies)


@dataclass(frozen=True)
class GraspSlopes:
    """Derivatives by a clamped grasp's pose, position [m] and rotation [rad] about the branch's
    axes: of force and torque about the moved pose [6, 6], and of nodes [node_count, 3, 6]."""

    wrench: np.ndarray
    displacement: np.ndarray


def grasp_slopes(model: BranchModel, grasp: Grasp, displacement: np.ndarray) -> GraspSlopes:
    """Differentiate an equilibrium [node_count, 3] by the pose of the clamped grasp that holds
    it."""
    pose = grasp.pose_of(model.mesh.nodes, displacement)
    positions = model.mesh.nodes[grasp.nodes] + displacement[grasp.nodes]
    arm = positions - pose[:3]
    tangent = model.equations([grasp]).exact_tangent(model, displacement)
    state = model.internal(displacement)
    held = state.force[grasp.nodes] - model.weight_force[grasp.nodes]
    rigid = np.zeros((6, *displacement.shape))
    for k in range(6):
        axis = np.eye(3)[k % 3]
        rigid[k, grasp.nodes] = axis if k < 3 else np.cross(axis, arm)
    followed = tangent.solve_all([-model.tangent_times(displacement, moved) for moved in rigid])
    stiffness = np.empty((6, 6))
    for k, (moved, change) in enumerate(zip(rigid, followed, strict=True)):
        change += moved
        forces = model.tangent_times(displacement, change)[grasp.nodes]
        stiffness[:3, k] = forces.sum(axis=0)
        stiffness[3:, k] = np.cross(arm, forces).sum(axis=0)
        if k >= 3:
            stiffness[3:, k] += np.cross(moved[grasp.nodes], held).sum(axis=0)
    return GraspSlopes(stiffness, np.stack(followed, axis=-1))


def refined_solve(tangent: Tangent, force: Callable[[np.ndarray], np.ndarray],
                  right: np.ndarray, tolerance: float = 1e-10) -> np.ndarray:
    """Return x with force(x) = right on free nodes, to ``tolerance``, from a nearby tangent."""
    equations, solution = tangent.equations, tangent.solve(right)
    scale = np.linalg.norm(equations.free_part(right))
    last = np.inf
    for _ in range(_REFINEMENTS):
        left = equations.free_part(right - force(solution))
        norm = float(np.linalg.norm(left))
        if norm <= tolerance * scale or norm >= 0.5 * last:
            # Round-off is reached, or the factor is too far from the tangent to improve further.
            break
        last = norm
        solution = solution + tangent.solve(left)
    return solution


def lame_changes(model: BranchModel, parameters: ParameterSet,
                 ) -> list[tuple[np.ndarray, np.ndarray] | None]:
    """Return for each column the derivative of the Lamé coefficients; None if they are constant."""
    changes: list[tuple[np.ndarray, np.ndarray] | None] = []
    for name in parameters.names:
        if name == "log_young":
            changes += [(model.lame_lambda * part, model.lame_mu * part)
                        for part in young_shares(model, parameters)]
        elif name == "log_bulk_over_shear":
            changes.append(lame_by_bulk(model.young * model.stiffening, model.poisson))
        else:
            changes.append(None)
    return changes


def young_shares(model: BranchModel, parameters: ParameterSet) -> np.ndarray:
    """Return d log E_tet / d log E_k, shape [K, tet_count]."""
    if parameters.shares is not None:
        return parameters.shares
    if parameters.weights is None:
        return np.ones((1, model.mesh.tet_count))
    control = parameters.control_young
    if control is None:
        control = np.linalg.lstsq(parameters.weights, model.young, rcond=None)[0]
    mapped = parameters.weights @ control
    if np.abs(mapped / model.young - 1).max() > 1e-6:
        raise InputError("Young's modulus differs from what the weights give.",
                         "The model's field must be weights @ control_young.",
                         "Create the model with with_young(weights @ control_young).")
    return (parameters.weights * control).T / mapped


def explicit_forces(model: BranchModel, parameters: ParameterSet, displacement: np.ndarray, *,
                    motion: MotionState | None = None,
                    viscous: Viscous | None = None) -> list[np.ndarray]:
    """Return the derivatives [node_count, 3] [N per parameter] of internal and inertial force less
    load, at fixed motion (None: equilibrium)."""
    changes, partials = lame_changes(model, parameters), []
    plain = [name.rsplit("_", 1)[0] if name.startswith("log_young") else name
             for name in parameters.labels()]
    for name, change in zip(plain, changes, strict=True):
        if change is not None:
            partials.append(model.internal(displacement, lame_pair=change,
                                           viscous=viscous).force)
        elif name == "log_density":
            partials.append(_density_force(model, displacement, motion))
        else:
            partials.append(np.zeros_like(displacement) if motion is None
                            else _damping_force(model, name, motion, viscous))
    return partials


def viscous_force(model: BranchModel, displacement: np.ndarray,
                  strain: np.ndarray) -> np.ndarray:
    """Return the nodal forces [N] of the stress for ``strain`` [tet_count, q, 6]."""
    return (model.internal(displacement, viscous=Viscous(1.0, strain)).force
            - model.internal(displacement).force)


def _density_force(model: BranchModel, displacement: np.ndarray,
                   motion: MotionState | None) -> np.ndarray:
    bare = model.without_point_masses()
    force = -bare.weight_force
    if bare.weight_stiffness is not None:
        # The prestress that carries the weight is proportional to it.
        force = force + product_with(bare.weight_stiffness, displacement)
    if motion is not None:
        force = force + bare.mass_times(
            motion.acceleration + model.damping.mass * motion.velocity)
    return force


def _damping_force(model: BranchModel, name: str, motion: MotionState,
                   viscous: Viscous | None) -> np.ndarray:
    if name == "damping_mass":
        return model.mass_times(motion.velocity)
    if viscous is None:
        return np.zeros_like(motion.displacement)
    # The viscous force is linear in the factor.
    return (model.internal(motion.displacement, viscous=viscous).force
            - model.internal(motion.displacement).force) / model.damping.stiffness


def explicit_energies(model: BranchModel, parameters: ParameterSet,
                      displacement: np.ndarray) -> np.ndarray:
    """Return the derivative of the strain energy [J per parameter] at a fixed displacement."""
    return np.array([0.0 if change is None
                     else model.internal(displacement, lame_pair=change).strain_energy
                     for change in lame_changes(model, parameters)])


def reactions(grasps: Sequence[Grasp], out: np.ndarray) -> np.ndarray:
    """Return the force on each grasp [N], shape [grasps, 3], from forces ``out`` on all nodes."""
    return np.array([
        grasp.weights @ out[grasp.nodes] / (grasp.weights @ grasp.weights)
        if grasp.mode == "point" else out[grasp.nodes].sum(axis=0)
        for grasp in grasps]).reshape(-1, 3)


def checked_names(names: Sequence[str]) -> tuple[str, ...]:
    """Return the names as a tuple. InputError if a name is not in PARAMETERS."""
    for name in names:
        if name not in PARAMETERS:
            raise InputError(f"There is no parameter {name!r}.",
                             f"The parameters are {', '.join(PARAMETERS)}.", "Choose one of those.")
    return tuple(names)
