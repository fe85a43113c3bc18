"""The stored state of the branch at one grasp position, and samples from such states."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from limber.mechanics import StaticResult
from limber.mechanics.statics.result import Status
from limber.planning.field.grasp_model import CorrectedResult, GraspModel, Guess, refusal
from limber.planning.field.radial import RadialInterpolant

# What the branch model found at grasp poses: the samples of an energy field.

LOADS = ("strain", "stress", "axial_force", "torque", "closeness")
"""Loads of a pose besides energy and force: largest strain and stress [Pa] by magnitude; the
gripper's force along the branch [N], outward positive, and its torque [Nm]; closeness of the branch
to an obstacle, 1 where it touches one. A plan's constraints may add more.
"""


@dataclass(frozen=True)
class GraspSamples:
    """Results of the branch model at ``m`` accepted grasp poses, rest pose first.

    Attributes:
        poses: Position [m] and natural rotation vector of the grasped piece [rad], [m, 6].
        energies: Potential of strain and weight above the hanging state [J], shape [m].
        forces: Force that the gripper exerts on the branch [N], shape [m, 3].
        tips: Position of the branch's tip [m], shape [m, 3].
        min_det_f: Least determinant of the deformation gradient, shape [m].
        rejected_poses: Poses without an acceptable solution, shape [q, 6].
        strains: Largest principal Green-Lagrange strain by magnitude, shape [m].
        targets: Positions of the named targets [m], shape [m, targets, 3].
        torques: Torque that the gripper exerts about the pose's position [Nm], shape [m, 3].
        strain_places: Position of that strain in the rest shape [m], shape [m, 3].
        stresses: Largest principal Cauchy stress by magnitude [Pa], shape [m].
        shape_slopes: Slopes of natural rotation, tip and targets to the grasp's position, shape
            [m, 3, 6 + 3 targets].
        axial_forces: Component of the force along the branch at the grasp, outward [N], shape [m].
        reduced: Whether the reduced model found the sample, corrected once by the full one; the
            full model alone found the others, and all of a file without this entry; shape [m].
        added: Quantities of a plan's constraints, by their names, shape [m] each; in no file.
    """

    poses: np.ndarray
    energies: np.ndarray
    forces: np.ndarray
    tips: np.ndarray
    min_det_f: np.ndarray
    rejected_poses: np.ndarray
    strains: np.ndarray | None
    targets: np.ndarray | None = None
    torques: np.ndarray | None = None
    strain_places: np.ndarray | None = None
    stresses: np.ndarray | None = None
    shape_slopes: np.ndarray | None = None
    axial_forces: np.ndarray | None = None
    reduced: np.ndarray | None = None
    added: dict[str, np.ndarray] = field(default_factory=dict)

    @property
    def positions(self) -> np.ndarray:
        return self.poses[:, :3]

    @property
    def shape(self) -> np.ndarray:
        """Natural rotation, tip and targets, shape [m, 6 + 3 targets]."""
        known = [self.poses[:, 3:], self.tips]
        if self.targets is not None:
            known.append(self.targets.reshape(len(self.poses), -1))
        return np.hstack(known)

    @property
    def loads(self) -> dict[str, np.ndarray | None]:
        """Loads by the names of ``LOADS`` and of added ones, shape [m] each; None if not known."""
        torque = None if self.torques is None else np.linalg.norm(self.torques, axis=1)
        known = (self.strains, self.stresses, self.axial_forces, torque, None)
        return dict(zip(LOADS, known, strict=True)) | self.added

    @property
    def load_table(self) -> np.ndarray:
        """The same as columns, shape [m, loads]; 0 if not known."""
        nothing = np.zeros(len(self.poses))
        return np.column_stack([nothing if one is None else one for one in self.loads.values()])

    def joined(self, other: "GraspSamples") -> "GraspSamples":
        """Return these samples followed by those of ``other``."""
        if self.reduced is not None and other.reduced is None:
            other = replace(other, reduced=np.zeros(len(other.poses), bool))
        added = {name: np.concatenate([values, other.added[name]])
                 for name, values in self.added.items()}
        return replace(self, added=added, **{
            name: np.concatenate([values, getattr(other, name)])
            for name, values in vars(self).items()
            if name != "added" and values is not None and getattr(other, name) is not None})

    def take(self, index: np.ndarray) -> "GraspSamples":
        """Return the samples of ``index``; rejected poses stay."""
        added = {name: values[index] for name, values in self.added.items()}
        return replace(self, added=added, **{
            name: values[index] for name, values in vars(self).items()
            if name not in ("added", "rejected_poses") and values is not None})


@dataclass(frozen=True)
class Solved:
    """A solution as a sample of :class:`~.energy_field.GraspSamples`, asked at number ``target``
    (-1: none). ``trouble`` is why not to trust it; ``tangents`` [3, node_count, 3] are the change
    with the grasp's position in single precision; ``reduced``: the reduced model found it."""

    target: int
    pose: np.ndarray
    energy: float
    force: np.ndarray
    tip: np.ndarray
    min_det_f: float
    trouble: Status | None
    targets: np.ndarray
    torque: np.ndarray
    strain: float
    strain_place: np.ndarray
    stress: float
    shape_slopes: np.ndarray
    axial_force: float
    displacement: np.ndarray
    tangents: np.ndarray
    reduced: bool = False

    @property
    def shape(self) -> np.ndarray:
        """Natural rotation [rad], tip and targets [m] in one row, [6 + 3 targets]."""
        return np.concatenate([self.pose[3:], self.tip, self.targets.ravel()])

    @property
    def has_tangents(self) -> bool:
        """Whether they are known; at a snap they are not."""
        return bool(np.isfinite(self.tangents[0, 0, 0]))

    def extrapolated(self, position: np.ndarray) -> np.ndarray | None:
        """Return the displacement by the tangents with the grasp at ``position`` [3], if known."""
        if not self.has_tangents:
            return None
        return self.displacement + self.moved(position - self.pose[:3])

    def moved(self, step: np.ndarray) -> np.ndarray:
        """Return the tangents' displacement for a ``step`` [3] of the grasp, [node_count, 3]."""
        # Not by BLAS, whose last digit may differ between processes.
        return step[0] * self.tangents[0] + step[1] * self.tangents[1] + step[2] * self.tangents[2]


def taken(grasp_model: GraspModel, result: StaticResult, target: int = -1) -> Solved:
    """Return the stored state of a solution."""
    moved, at_rest = result.displacement, result is grasp_model.rest
    strain, position, stress = grasp_model.peak_load(moved)
    tangents = grasp_model.tangents(moved)
    force = np.zeros(3) if at_rest else result.reaction_force
    return Solved(
        target, grasp_model.pose(moved), 0.0 if at_rest else grasp_model.energy(result),
        force, grasp_model.tip(moved),
        float(result.min_det_f), refusal(result), grasp_model.branch.target_positions(moved),
        np.zeros(3) if at_rest else result.reaction_torque, strain, position, stress,
        grasp_model.shape_slopes(moved, tangents), grasp_model.axial_force(moved, force), moved,
        tangents.astype(np.float32), isinstance(result, CorrectedResult))


def samples_of(good: Sequence[Solved], rejected: np.ndarray) -> GraspSamples:
    """Return samples of solutions, the rest state first; ``rejected`` positions [m], [q, 3]."""
    def column(name: str) -> np.ndarray:
        return np.array([getattr(one, name) for one in good])

    return GraspSamples(
        poses=column("pose"), energies=column("energy"), forces=column("force"),
        tips=column("tip"), min_det_f=column("min_det_f"),
        rejected_poses=np.hstack([rejected, np.zeros_like(rejected)]), strains=column("strain"),
        targets=column("targets"), torques=column("torque"),
        strain_places=column("strain_place"), stresses=column("stress"),
        shape_slopes=column("shape_slopes"), axial_forces=column("axial_force"),
        reduced=column("reduced"))


# Guess of a branch's shape for a grasp position, from the nearby states.
#
# Displacements between two states that are rotated against each other are too short: they contain
# strain that neither state has, and bending costs a thousandth of that. So the strain is
# interpolated by itself, to first order about each state. From there Newton's iteration, whose
# stress is then right, takes half as many steps.

_STATES = 6  # states around a position that are used
_SURE = 0.02  # fraction of the length by which they may differ from the nearest state
_DISTINCT_STATES = 0.002  # fraction of the length by which two states differ
_KERNEL: dict[str, Any] = {"kernel": "cubic", "smoothing": 1e-9}
_STRAIGHT = 0.9  # cosine of a path's turn below which it is not continued
_STRAIN_DIFFERENCE = 1e-4  # fraction of a state's change by which its strain's change is measured

Share = tuple[float, np.ndarray, np.ndarray]
"""Terms of a state in a guess: weight, displacement, and its change by the tangents."""


def guess_of(grasp_model: GraspModel, known: Sequence[Solved], positions: np.ndarray,
             position: np.ndarray) -> Guess | None:
    """Guess the branch's shape with the grasp at a position (None: nothing known, empty: not
    needed), by Hermite radial interpolation of states near it, or the nearest if they disagree: it
    may have buckled to another side."""
    if not grasp_model.needs_guess:
        return Guess()
    length = grasp_model.reach.arc_length
    states: list[Solved] = []
    for k in np.argsort(np.linalg.norm(positions - position, axis=1), kind="stable")[:2 * _STATES]:
        gaps = [np.linalg.norm(one.pose[:3] - positions[k]) for one in states]
        if known[k].has_tangents and min(gaps, default=np.inf) > _DISTINCT_STATES * length:
            states.append(known[k])
        if len(states) == _STATES:
            break
    if not states:
        return None
    if len(states) == _STATES:
        shares = _interpolated(states, position)
        off = np.linalg.norm(_displacement(shares) - states[0].extrapolated(position), axis=1).max()
        if off <= _SURE * length:
            return blended(grasp_model, shares)
    return extrapolated(grasp_model, states[0], position)


def extrapolated(grasp_model: GraspModel, state: Solved, position: np.ndarray) -> Guess | None:
    """Return the prediction of a state's tangents at ``position`` [3], None if it has none."""
    if not state.has_tangents:
        return None
    return blended(grasp_model, [_share(1.0, state, position - state.pose[:3])])


def midpoint_blend(grasp_model: GraspModel, first: Solved, second: Solved, position: np.ndarray,
                   ) -> Guess | None:
    """Return the blend of both states' values and slopes near half-way, None without slopes."""
    if not (first.has_tangents and second.has_tangents):
        return None
    straight = 0.5 * (first.pose[:3] + second.pose[:3])
    return blended(grasp_model, [
        _share(0.5, one, 0.25 * (position - one.pose[:3] + position - straight))
        for one in (first, second)])


def straight_on(grasp_model: GraspModel, before: np.ndarray, now: np.ndarray, position: np.ndarray,
                ) -> Guess | None:
    """Extrapolate two states [node_count, 3] on a path to the next position: by the second's
    tangents and the path's curvature. None if the path turns or the branch may snap."""
    here = grasp_model.pose(now)[:3]
    back, on = grasp_model.pose(before)[:3] - here, position - here
    size = float(np.linalg.norm(back) * np.linalg.norm(on))
    if size == 0.0 or back @ on > -_STRAIGHT * size:
        return None
    tangents = grasp_model.tangents(now)
    if not np.isfinite(tangents).all():
        return None
    bend = float(on @ on / (back @ back))
    return blended(grasp_model, [
        (1.0 - bend, now, np.tensordot(on - bend * back, tangents, 1)),
        (bend, before, np.zeros_like(now))])


def blended(grasp_model: GraspModel, shares: Sequence[Share]) -> Guess:
    """Return the sum of the states' displacements and their changes, each with its weight, and
    likewise of their strains; empty if the model needs no guess."""
    if not grasp_model.needs_guess:
        return Guess()
    strains = grasp_model.model.strains
    strain: Any = 0.0
    for weight, displacement, change in shares:
        own = strains(displacement)
        near = strains(displacement + _STRAIN_DIFFERENCE * change)
        strain = strain + weight * own + (near - own) / _STRAIN_DIFFERENCE
    return Guess(_displacement(shares), strain)


def _share(weight: float, state: Solved, shift: np.ndarray) -> Share:
    return weight, state.displacement, state.moved(shift)


def _displacement(shares: Sequence[Share]) -> np.ndarray:
    return sum(weight * displacement + change for weight, displacement, change in shares)


def _interpolated(states: list[Solved], position: np.ndarray) -> list[Share]:
    points = np.array([one.pose[:3] for one in states])
    count = len(points)
    # Contribution of each value, and each slope: the interpolation of unit data.
    unit = np.eye(4 * count)
    weights = RadialInterpolant.fit(points, unit[:count], unit[count:].reshape(count, 3, -1),
                                    **_KERNEL).value(position[None])[0]
    slopes = weights[count:].reshape(count, 3)
    return [_share(weights[k], one, slopes[k]) for k, one in enumerate(states)]
