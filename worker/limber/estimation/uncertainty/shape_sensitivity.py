"""First-order effect of shape and mass, which the fit takes as known, on pulls and moduli.

All nodes X of the mesh go a way w aside, to another shape of the same tree; or what hangs on the
branch is heavier. At a state u in balance the internal force f, the loads p and what holds the
branch change, and the state follows:

    K du = dp - df,      df = (f(X + s w, u) - f(X, u)) / s  for a small s,

with the tangent stiffness K that belongs to the state. So one factor a key frame serves all shapes,
at an assembled force and a solve each, where a mesh of its own would have to find its own states.
What the fit would have taken up in the moduli follows from the change of its residuals.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from limber.estimation.fitting.nuisances import ErrorSlopes
from limber.estimation.fitting.objective import Evaluation, Objective
from limber.estimation.forward.quasi_static import QuasiStaticForward
from limber.estimation.parameters import Values
from limber.geometry.tets.tet_mesh import TetMesh
from limber.mechanics.linear.equations import Tangent
from limber.mechanics.model import BranchModel
from limber.mechanics.points import point_operator
from limber.mechanics.sensitivities import reactions
from limber.recordings.cell_errors import calibration_of

STEP = 1e-4
"""Part of the way to another shape, or of a mass, over which the force's derivative is taken: a
branch turned by a radian answers far from linearly to the whole of a radius' change."""


def taken_up(evaluation: Evaluation, objective: Objective,
             slopes: Callable[[QuasiStaticForward, Values], ErrorSlopes]) -> np.ndarray | None:
    """Change of log E at the control points by which a fit takes up S changes of its pulls, [K, S].

    Linear in the change of the residuals r: d log E = -(J^T J)^-1 J^T dr, at few key frames:
    differences vary slowly along a pull.

    Args:
        evaluation: At the fit's end.
        objective: What was minimised.
        slopes: Change of a pull, simulated for these values, by each of the S.

    Returns:
        None where a pull is dynamic, since that would take too long, or finds no equilibrium.
    """
    if any(forward.entry.motion == "dynamic" for forward in objective.forwards):
        return None
    forwards = [forward.led_elsewhere(forward.frames.poses) for forward in objective.forwards]
    alone = Objective(forwards, objective.space, force_sigma=objective.force_sigma)
    expected = alone.evaluate(evaluation.free, jacobian=True)
    if expected is None:
        return None
    values = objective.space.unpack(evaluation.free)
    changes = alone.residual_slopes(expected, [
        slopes(forward, values) for forward in forwards if isinstance(forward, QuasiStaticForward)])
    steps = np.linalg.lstsq(expected.slopes, -changes, rcond=1e-9)[0]
    return steps[list(objective.space.groups)]


def shape_slopes(forward: QuasiStaticForward, values: Values, meshes: Sequence[TetMesh],
                 ) -> ErrorSlopes:
    """Return the change of a pull's observations by each of S other shapes.

    Args:
        forward: Simulated for ``values`` last.
        values: The physical parameters.
        meshes: The same tetrahedra with their nodes elsewhere.
    """
    nodes = forward.mesh.nodes
    operator = point_operator(forward.mesh, forward.rest_points)
    return _slopes(forward, values,
                   [forward.aside(nodes + STEP * (mesh.nodes - nodes)) for mesh in meshes],
                   [point_operator(mesh, forward.rest_points) - operator for mesh in meshes])


def hung_slopes(forward: QuasiStaticForward, values: Values) -> ErrorSlopes:
    """Return the change of a pull's observations by the mass of what hangs on the branch, relative.

    Arguments as of :func:`shape_slopes`.
    """
    size = 3 * len(forward.rest_points), forward.mesh.nodes.size
    return _slopes(forward, values, [forward.with_hung_mass(1 + STEP)], [sparse.csr_matrix(size)])


def grip_slopes(forward: QuasiStaticForward, values: Values) -> ErrorSlopes:
    """Return the change of a pull's observations by the deviation of the length in its gripper.

    Arguments as of :func:`shape_slopes`.
    """
    size = 3 * len(forward.rest_points), forward.mesh.nodes.size
    longer = STEP * calibration_of(forward.entry).held_length_sigma_m
    return _slopes(forward, values, [forward.with_longer_grip(longer)], [sparse.csr_matrix(size)])


def _slopes(forward: QuasiStaticForward, values: Values, asides: Sequence[QuasiStaticForward],
            elsewhere: Sequence[sparse.csr_matrix]) -> ErrorSlopes:
    """Changes to pulls that are a step aside, where points may sit in the mesh elsewhere."""
    here = _Pulled(forward, forward.model_with(values))
    equations = here.model.equations((forward.grasp,) if here.is_held else ())
    operator = point_operator(here.model.mesh, forward.rest_points)
    others = [_Pulled(aside, aside.model_with(values)) for aside in asides]
    changes = []
    for key, state in enumerate(forward.displacements()):
        before = here.out_of_balance(key, state)
        seen = here.seen(key, state, before)
        tangent = equations.exact_tangent(here.model, state)
        for there, ways, (moved, out) in zip(others, elsewhere, _followed(
                here, others, key, state, tangent, before), strict=True):
            points = operator @ moved.ravel() + ways @ state.ravel()
            after = there.seen(key, state + STEP * moved, out)
            changes.append([points.reshape(-1, 3), *(
                (now - then) / STEP for now, then in zip(after, seen, strict=True))])
    return ErrorSlopes(*(
        np.einsum("fk,ks...->f...s", forward.spread, np.array(each).reshape(
            -1, len(others), *each[0].shape)) for each in zip(*changes, strict=True)))


@dataclass(frozen=True)
class _Pulled:
    """A pull on one shape, with the parameters in question."""

    forward: QuasiStaticForward
    model: BranchModel

    @property
    def is_held(self) -> bool:
        return self.forward.drive == "pose"

    def out_of_balance(self, key: int, state: np.ndarray) -> np.ndarray:
        """Internal force less load [N], shape [n, 3]."""
        load = self.model.weight_force
        if not self.is_held:
            load = load + self.forward.load_at(key)
        return self.model.internal(state).force - load

    def hold(self, key: int, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Displacement of the nodes that are clamped [n, 3], and what is missing of the mean of
        those that are pinned [p, 3].
        """
        held, grasp = np.zeros_like(state), self.forward.grasp
        if not self.is_held:
            return held, np.empty((0, 3))
        pose = self.forward.load_at(key)
        if grasp.mode == "pinned":
            return held, (pose[:3] - grasp.centre - grasp.weights @ state[grasp.nodes])[None]
        held[grasp.nodes] = grasp.displacement(self.model.mesh.nodes, pose)
        return held, np.empty((0, 3))

    def seen(self, key: int, state: np.ndarray, out: np.ndarray,
             ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The gripper's force [N], its torque about the recorded place [N m], and its place [m].

        Where a force leads, force and torque are what they are.
        """
        grasp, place = self.forward.grasp, self.forward.place(state)
        if not self.is_held:
            return np.zeros(3), np.zeros(3), place
        about = self.forward.frames.poses[self.forward.keys[key], :3]
        arms = (self.model.mesh.nodes + state)[grasp.nodes] - about
        return (reactions([grasp], out)[0], np.cross(arms, out[grasp.nodes]).sum(axis=0), place)


def _followed(here: _Pulled, others: Sequence[_Pulled], key: int, state: np.ndarray,
              tangent: Tangent, before: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """How the state follows to each of the others [m over the whole way], and what is out of
    balance there after a step.
    """
    held, missing = here.hold(key, state)
    moved, rights, pins, after = [], [], [], []
    for there in others:
        held_there, missing_there = there.hold(key, state)
        moved.append((held_there - held) / STEP)
        pins.append(np.ravel(missing_there - missing) / STEP)
        after.append(there.out_of_balance(key, state))
        rights.append((before - after[-1]) / STEP - here.model.tangent_times(state, moved[-1]))
    found = tangent.solve_all(rights, np.column_stack(pins))
    return [(led + free, out + STEP * here.model.tangent_times(state, led + free))
            for led, free, out in zip(moved, found, after, strict=True)]
