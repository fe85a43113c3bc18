"""Uncertainty of Young's modulus from the shape of the scan and the mass of twigs.

Branches that fit the scan as well as the fitted one (:mod:`limber.geometry.shape_samples`) are
pulled as the branch was, with the estimated moduli. To first order, the fit would have attributed
the differences of their points and forces to the moduli; that is the possible error of the moduli.
Errors at neighbouring positions, of axis and radius, and of several moduli are correlated as in the
scan.
"""

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from limber.core.not_none import present
from limber.core.progress import SILENT, Progress
from limber.estimation.estimated_branch import Subject
from limber.estimation.fitting.objective import Evaluation, Objective
from limber.estimation.forward.forward_model import Simulated, key_frames
from limber.estimation.forward.solved_pull import FEW_KEYS, QuasiStaticForward
from limber.estimation.parameters import Values, YoungField
from limber.estimation.uncertainty.model_error import WIDEST
from limber.geometry.shape_samples import reshaped, sample_skeletons
from limber.geometry.skeleton.radii.fit_kernels import on_cylinders
from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.tets.tet_mesh import TetMesh
from limber.mechanics.added_masses import HungTwig
from limber.mechanics.linear.equations import Tangent
from limber.mechanics.materials.materials import LayeredSection
from limber.mechanics.model import BranchModel
from limber.mechanics.points import point_operator
from limber.mechanics.sensitivities import reactions
from limber.recordings.recording import calibration_of

# First-order effect of shape and mass, which the fit assumes known, on pulls and moduli.
#
# All nodes X of the mesh move by w to another shape of the same tree; or the added masses on the
# branch become heavier. At an equilibrium state u the internal force f, the loads p and the
# constraints of the branch change, and the state follows:
#
#     K du = dp - df,      df = (f(X + s w, u) - f(X, u)) / s  for a small s,
#
# with the tangent stiffness K of the state. One factor per key frame thus serves all shapes, at the
# cost of one assembled force and one solve each; a separate mesh would have to find its own states.
# The change of the residuals gives the change of the moduli that the fit would have made.

STEP = 1e-4
"""Fraction of the change to another shape or mass over which the force's derivative is taken: the
response of a branch turned by a radian to the whole change of a radius is far from linear.
"""


def compensation(evaluation: Evaluation, objective: Objective,
                 slopes: Callable[[QuasiStaticForward, Values], Simulated]) -> np.ndarray | None:
    """Return the change of log E [K, S] by which a fit compensates S changes, -(J^T J)^-1 J^T dr,
    at the states where it ended. None if a pull is dynamic or on a reduced model."""
    forwards = _slow(objective)
    if len(forwards) < len(objective.forwards):
        return None
    values = objective.space.unpack(evaluation.free)
    changes, known = (objective.residual_slopes(evaluation, each) for each in (
        [slopes(forward, values) for forward in forwards],
        # As much is shown of these, or what is not would be taken for the change.
        [_as_shown(forward, pull) for forward, pull in zip(
            forwards, evaluation.pulls, strict=True)]))
    by_free = objective.on_free(known)
    rows, _ = objective.space.own_rows()
    by_free[len(by_free) - len(rows):] = rows
    steps = np.linalg.lstsq(by_free, -changes, rcond=1e-9)[0]
    return steps[list(objective.space.groups)]


def _slow(objective: Objective) -> list[QuasiStaticForward]:
    return [each for each in objective.forwards if isinstance(each, QuasiStaticForward)]


def _shown(forward: QuasiStaticForward) -> tuple[np.ndarray, np.ndarray]:
    """Few of a pull's key frames [k], and S [f, k] with values at all frames = S @ those there."""
    keys, spread = key_frames(np.arange(float(forward.key_count)), FEW_KEYS)
    return keys, forward.spread @ spread


def _as_shown(forward: QuasiStaticForward, pull: Simulated) -> Simulated:
    """A pull's derivatives by its few key frames."""
    keys, spread = _shown(forward)
    return present(pull.slopes, "derivatives").each(
        lambda at_frames: np.tensordot(spread, at_frames[forward.keys[keys]], axes=1))


def shape_slopes(forward: QuasiStaticForward, values: Values, meshes: Sequence[TetMesh],
                 ) -> Simulated:
    """Return the change of a pull, last simulated for ``values``, by each of S shapes of its
    mesh."""
    nodes = forward.mesh.nodes
    return _slopes(forward, values, [
        forward.aside(nodes + STEP * (mesh.nodes - nodes)) for mesh in meshes])


def _slopes(forward: QuasiStaticForward, values: Values, asides: Sequence[QuasiStaticForward],
            ) -> Simulated:
    """Changes of pulls by a step; the points may then be elsewhere in the mesh."""
    here = _Pulled(forward, forward.model_with(values))
    equations = here.model.equations((forward.grasp,) if here.is_held else ())
    operator = point_operator(here.model.mesh, forward.rest_points)
    others = [_Pulled(aside, aside.model_with(values)) for aside in asides]
    elsewhere = [(point_operator(aside.mesh, forward.rest_points) - operator) / STEP
                 for aside in asides]
    changes = []
    shown, spread = _shown(forward)
    for key in shown:
        state = forward.states()[key].displacement
        before = here.out_of_balance(key, state)
        seen = here.seen(key, state, before)
        tangent = equations.exact_tangent(here.model, state)
        for other, paths, (moved, out) in zip(others, elsewhere, _followed(
                here, others, key, state, tangent, before), strict=True):
            points = operator @ moved.ravel() + paths @ state.ravel()
            after = other.seen(key, state + STEP * moved, out)
            changes.append([points.reshape(-1, 3), *(
                (now - then) / STEP for now, then in zip(after, seen, strict=True))])
    return Simulated(*(
        np.einsum("fk,ks...->f...s", spread, np.array(each).reshape(
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
        """Displacement of the clamped nodes [n, 3], and missing displacement of the means of the
        pinned ones [p, 3]."""
        held, grasp = np.zeros_like(state), self.forward.grasp
        if not self.is_held:
            return held, np.empty((0, 3))
        pose = self.forward.load_at(key)
        if grasp.mode == "point":
            return held, (pose[:3] - grasp.centre - grasp.weights @ state[grasp.nodes])[None]
        held[grasp.nodes] = grasp.displacement(self.model.mesh.nodes, pose)
        return held, np.empty((0, 3))

    def seen(self, key: int, state: np.ndarray, out: np.ndarray,
             ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The gripper's force [N], its torque about the recorded position [N m], and its position
        [m]. If a force drives, force and torque do not change."""
        grasp, position = self.forward.grasp, self.forward.grasp_position(state)
        if not self.is_held:
            return np.zeros(3), np.zeros(3), position
        about = self.forward.frames.poses[self.forward.keys[key], :3]
        arms = (self.model.mesh.nodes + state)[grasp.nodes] - about
        return (reactions([grasp], out)[0], np.cross(arms, out[grasp.nodes]).sum(axis=0), position)


def _followed(here: _Pulled, others: Sequence[_Pulled], key: int, state: np.ndarray,
              tangent: Tangent, before: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Response of the state to each of the others [m over the whole path], and the imbalance there
    after a step."""
    held, missing = here.hold(key, state)
    moved, rights, pins, after = [], [], [], []
    for forward in others:
        held_there, missing_there = forward.hold(key, state)
        moved.append((held_there - held) / STEP)
        pins.append(np.ravel(missing_there - missing) / STEP)
        after.append(forward.out_of_balance(key, state))
        rights.append((before - after[-1]) / STEP - here.model.tangent_times(state, moved[-1]))
    found = tangent.solve_all(rights, np.column_stack(pins))
    return [(imposed + free, out + STEP * here.model.tangent_times(state, imposed + free))
            for imposed, free, out in zip(moved, found, after, strict=True)]


def grip_error(evaluation: Evaluation, objective: Objective) -> np.ndarray | None:
    """Return the relative deviation of E [K] from the held length (``held_length_sigma_m``), which
    soft pads and jaws hide, the same in all pulls. None if no gripper clamps or the length is
    known, or as :func:`compensation`."""
    if not any(forward.entry.grasp.mode == "rigid"
               and calibration_of(forward.entry).held_length_sigma_m > 0
               for forward in objective.forwards):
        return None
    return _error_of(evaluation, objective, lambda forward: forward.with_longer_grip(
        STEP * calibration_of(forward.entry).held_length_sigma_m))


def _error_of(evaluation: Evaluation, objective: Objective,
              aside: Callable[[QuasiStaticForward], QuasiStaticForward]) -> np.ndarray | None:
    """Relative deviation of E [K] from one unknown, whose step each pull has in the other one."""
    steps = compensation(evaluation, objective, lambda forward, values: _slopes(
        forward, values, [aside(forward)]))
    return None if steps is None else np.minimum(np.abs(steps[:, 0]), WIDEST)


# Bending stiffness E I along a branch: what a pull determines even if the radius is uncertain.
#
# If the scan is too thick, the estimate of E is too low, and the model bends as the branch does.
# So the interval of E I is narrower than that of E, and predictions on the same mesh depend on E I.
#
# A pull does not determine E I at a position but over a length of the branch: a radius may step at
# a fork beside a control point. I is therefore a mean over the branch, each piece by what the fit
# would have added to log E there had this piece been stiffer than its radius says. Then the error
# of a radius cancels, wherever it is, and where the branch is not bent nothing is determined.

PIECES = 12
"""Intervals between the pieces along the main path."""


def effect_of_pieces(evaluation: Evaluation, objective: Objective, pieces: np.ndarray,
                     ) -> np.ndarray | None:
    """Return the part [K, P] of a higher log stiffness of each piece of the mesh, ``pieces``
    [tet_count, P], that the estimated log E has. None as :func:`compensation`."""
    def slopes(forward: QuasiStaticForward, values: Values) -> Simulated:
        aside = copy.copy(forward)
        aside.field = _ByPieces(**vars(forward.field), pieces=pieces)
        found = aside.simulate(values, ("piece",) * (pieces.shape[1] - len(values.young)), True)
        return _as_shown(forward, present(found, "state at the end of the fit"))

    steps = compensation(evaluation, objective, slopes)
    return None if steps is None else -steps


@dataclass(frozen=True)
class _ByPieces(YoungField):
    """A field with derivatives to log E of pieces of the mesh instead of those to its unknowns."""

    pieces: np.ndarray | None = None

    def shares(self, values: Values, extra: tuple[str, ...]) -> np.ndarray:
        return present(self.pieces, "pieces of the mesh").T


@dataclass(frozen=True)
class SectionMean:
    """Mean over skeleton nodes of the main path, by ``share`` [K, node_count]."""

    share: np.ndarray

    @classmethod
    def of(cls, skeleton: Skeleton, mesh: TetMesh, weights: np.ndarray,
           effect: np.ndarray | None = None) -> "SectionMean":
        """Prepare the mean by ``effect`` [K, P] of pieces, with their ``weights`` [tet_count, P];
        None: over control points' parts, of such weights, by length."""
        low, high, fraction, _ = on_cylinders(skeleton, mesh.centroids)
        radius = (1 - fraction) * skeleton.radius[low] + fraction * skeleton.radius[high]
        # A twig's own bending does not contribute to that of the branch which carries it.
        each = weights * (np.isin(high, skeleton.main_path()) * np.abs(mesh.volumes)
                          / radius**2)[:, None]
        if effect is not None:
            each = each / np.maximum(each.sum(axis=0), 1e-300) @ effect.T
        share = np.array([
            np.bincount(low, (1 - fraction) * own, skeleton.node_count)
            + np.bincount(high, fraction * own, skeleton.node_count) for own in each.T])
        return cls(share / share.sum(axis=1, keepdims=True))

    def log_second_moment(self, radius: np.ndarray, section: LayeredSection | None = None,
                          ) -> np.ndarray:
        """Return the mean log second moment [K] [log m^4] by radius [node_count] [m]; layers count
        as so much wood."""
        carrying = 1.0 if section is None else section.bending_factor(radius)
        return self.share @ np.log(np.pi / 4 * radius**4 * carrying)


FEWEST = 8
"""Fewest shapes that show the spread."""
NEARER = 0.03
"""Fraction of the way to another shape at which the pull's response is taken: linear in the radius'
logarithm, as E I is. Over the whole way, radii off by a fifth would seem to change E I by a tenth.
"""


def shape_error(evaluation: Evaluation, objective: Objective, subject: Subject,
                points: np.ndarray, count: int, mean: SectionMean, *, seed: int = 0,
                progress: Progress = SILENT) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the relative deviations of E and E I [K] from axis and radii: RMS of what a fit would
    have changed over drawn shapes, times Student's quantile, since they are few. Even thickening
    leaves E I unchanged. None if too few shapes, or as :func:`compensation`."""
    if count < FEWEST:
        return None
    progress(0.0, "evaluating posterior samples of the shape")
    shapes = sample_skeletons(subject.skeleton, points, count, np.random.default_rng(seed))
    meshes = [reshaped(subject.mesh, subject.skeleton, _towards(subject.skeleton, shape))
              for shape in shapes]
    near = compensation(evaluation, objective,
                        lambda forward, values: shape_slopes(forward, values, meshes))
    if near is None:
        return None
    steps = near / NEARER
    thicker = 4 * mean.share @ np.log(np.column_stack(
        [shape.radius / subject.skeleton.radius for shape in shapes]))
    student, normal = scipy.special.stdtrit(count, 0.975), scipy.special.ndtri(0.975)
    of_young, of_bending = (np.minimum(np.sqrt(np.mean(change**2, axis=1)) * student / normal,
                                       WIDEST) for change in (steps, steps + thicker))
    return of_young, of_bending


def _towards(skeleton: Skeleton, shape: Skeleton) -> Skeleton:
    """The skeleton a small way towards another shape of it."""
    return replace(skeleton, nodes=skeleton.nodes + NEARER * (shape.nodes - skeleton.nodes),
                   radius=skeleton.radius * (shape.radius / skeleton.radius)**NEARER)


def hung_error(evaluation: Evaluation, objective: Objective, sigma: float) -> np.ndarray | None:
    """Return the relative deviation of E [K] from that of twigs and leaves outside the mesh,
    ``sigma``. None if nothing hangs or there is no gravity, or as :func:`compensation`."""
    models = [forward.model for forward in _slow(objective)]
    # Stated masses are known; those of twigs and leaves come from their volume.
    if not sigma or not any(
            model.gravity.any() and any(isinstance(one, HungTwig) for one in model.point_masses)
            for model in models):
        return None
    return _error_of(evaluation, objective,
                     lambda forward: forward.with_hung_mass(1 + sigma * STEP))
