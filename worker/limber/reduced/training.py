"""Full solutions that train a reduced model: sampled poses and moduli, states, tangents.

Beside each state its derivatives to the pose and to the log of Young's modulus at each control
point are taken from the factorised tangent: ten linear solves instead of ten equilibria, and the
basis made of them bears a change of Young's modulus that one of states alone does not.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from limber.core.errors import ConvergenceError, InputError
from limber.core.numerics.rigid import angle_between, rotation_matrix, rotation_vector
from limber.core.progress import SILENT, Progress
from limber.mechanics.grasp import RADIAN, Grasp
from limber.mechanics.linear.equations import Tangent
from limber.mechanics.model import BranchModel
from limber.mechanics.statics.solve import StaticResult, StaticSettings, solve_static

_YOUNG_SCALE = 0.1
"""Distance per factor e in Young's modulus, as a fraction of the extent. Chosen, not measured."""
_TIP_TURNS = 1.3
"""Rotation of a cantilever's end per rotation of its chord: between 1 (stiff) and 1.5 (small
deflection).
"""

_SWING = 0.14
"""Amplitude of the lowest vibration added to a state, as a fraction of the extent; higher ones are
smaller. About that of brisk motion. Chosen, not measured.
"""
_SWING_COUNT = 3
"""States swung out from one: chosen, not measured."""


@dataclass(frozen=True)
class TrainingSettings:
    """Settings of the training grasps of a reduced model.

    Attributes:
        grasp_count: Number of full solutions.
        reach: Largest displacement of the grasp, as part of the branch's extent.
        turn: Largest rotation of a clamped grasp away from the natural one [rad].
        young_spread: Young's modulus at each control point is sampled between 1/spread and
            spread times its value for every second grasp; 1: it is known and stays.
        vibration_every: Number of states after which the lowest vibrations, and states displaced
            along them, are added, as motion in time needs; 0: none.
    """

    grasp_count: int = 120
    reach: float = 0.38
    turn: float = 0.3
    young_spread: float = 4.0
    vibration_every: int = 6
    vibration_count: int = 4
    seed: int = 0

    def __post_init__(self) -> None:
        if self.grasp_count < 2 or not 0 < self.reach < 1 or self.young_spread < 1:
            raise InputError(
                f"The training has {self.grasp_count} grasps, reach {self.reach} and Young spread "
                f"{self.young_spread}.",
                "It needs at least 2 grasps, a reach between 0 and 1 and a spread of 1 or more.",
                "Keep the defaults.")


@dataclass
class Snapshots:
    """Full static solutions at poses [s, 6] [m, rad] and their tangents.

    Attributes:
        young: At the control points [Pa], shape [s, K].
        displacement: [m], shape [s, node_count, 3].
        energy: [J], shape [s].
        force: Of the gripper on the branch [N], shape [s, 3].
        pose_tangents: Derivative to the pose [m per m or rad], [s, 3 or 6, node_count, 3], single
            precision.
        young_tangents: Derivative to log Young at the control points, [s, K, node_count, 3];
            [s, 0, node_count, 3] where it is known.
        vibrations: Lowest modes about some of the states, scaled to a largest motion of 1 m,
            shape [v, node_count, 3]; ``vibration_states`` [v] are those states.
        swings: States with free ends swung out far along vibrations of ``swing_states`` [w], held
            at rest there by the loads that bend them so [m], shape [w, node_count, 3].
        failed: Number of requested grasps without an equilibrium.
    """

    poses: np.ndarray
    young: np.ndarray
    displacement: np.ndarray
    energy: np.ndarray
    force: np.ndarray
    pose_tangents: np.ndarray
    young_tangents: np.ndarray
    vibrations: np.ndarray
    vibration_states: np.ndarray
    swings: np.ndarray
    swing_states: np.ndarray
    failed: int = 0

    def __len__(self) -> int:
        return len(self.poses)

    def arrays(self) -> dict[str, np.ndarray]:
        """Return what a file needs to hold."""
        return {name: np.asarray(value) for name, value in vars(self).items()}

    @classmethod
    def from_arrays(cls, arrays: dict[str, np.ndarray]) -> "Snapshots":
        """Return the snapshots of :meth:`arrays`."""
        return cls(**{name: arrays[name] for name in cls.__dataclass_fields__
                      if name != "failed"}, failed=int(arrays["failed"]))

    def without_vibrations(self) -> "Snapshots":
        """Return the same for statics alone."""
        return replace(self, vibrations=self.vibrations[:0],
                       vibration_states=self.vibration_states[:0], swings=self.swings[:0],
                       swing_states=self.swing_states[:0])

    def joined(self, other: "Snapshots") -> "Snapshots":
        """Return these snapshots and those of ``other``."""
        parts = {name: np.concatenate([getattr(self, name), getattr(other, name)])
                 for name in ("poses", "young", "displacement", "energy", "force",
                              "pose_tangents", "young_tangents", "vibrations", "swings")}
        for name in ("vibration_states", "swing_states"):
            parts[name] = np.concatenate([getattr(self, name), getattr(other, name) + len(self)])
        return Snapshots(**parts, failed=self.failed + other.failed)


def sample_poses(model: BranchModel, grasp: Grasp, count: int, rng: np.random.Generator,
                 settings: TrainingSettings) -> np.ndarray:
    """Return random poses [count, 6] [m, rad] to which the branch can be bent: displacements in all
    directions, large ones more often, none that stretches it. A clamped grasp turns with the chord
    from the base, and up to ``settings.turn`` away from that."""
    base = model.mesh.nodes[model.fixed].mean(axis=0)
    arm = grasp.centre - base
    reach = min(settings.reach * model.extent, 0.9 * np.linalg.norm(arm))
    poses = np.zeros((count, 6))
    for pose in poses:
        while True:
            move = _unit(rng.normal(size=3)) * reach * np.sqrt(rng.uniform())
            chord = arm + move
            if 0.2 * np.linalg.norm(arm) < np.linalg.norm(chord) < 0.98 * np.linalg.norm(arm):
                break
        pose[:3] = grasp.centre + move
        if grasp.mode == "rigid":
            away = _unit(rng.normal(size=3)) * settings.turn * rng.uniform()
            pose[3:] = rotation_vector(rotation_matrix(away)
                                       @ rotation_matrix(natural_turn(arm, chord)))
    return poses


def natural_turn(arm: np.ndarray, chord: np.ndarray) -> np.ndarray:
    """Return the rotation vector [rad] of a held place whose chord to the base turns."""
    axis = np.cross(arm, chord)
    size = np.linalg.norm(axis)
    if size < 1e-12 * np.linalg.norm(arm) * np.linalg.norm(chord):
        return np.zeros(3)
    return axis / size * np.arctan2(size, arm @ chord) * _TIP_TURNS


def sample_young(control_young: np.ndarray, count: int, rng: np.random.Generator,
                 spread: float) -> np.ndarray:
    """Return Young's moduli [Pa], shape [count, K]: every second row the given one."""
    young = np.repeat(np.asarray(control_young, float)[None], count, axis=0)
    if spread > 1:
        varied = young[1::2]
        varied *= spread ** rng.uniform(-1, 1, varied.shape)
    return young


def pose_distance(model: BranchModel, poses: np.ndarray, young: np.ndarray, pose: np.ndarray,
                  control_young: np.ndarray) -> np.ndarray:
    """Return how far states are from a pose and modulus [m], shape [s]; for choosing starts."""
    turns = angle_between(pose[3:], np.atleast_2d(poses)[:, 3:])
    factor = np.abs(np.log(np.atleast_2d(young) / control_young)).max(axis=1)
    return (np.linalg.norm(np.atleast_2d(poses)[:, :3] - pose[:3], axis=1)
            + model.extent * (RADIAN * turns + _YOUNG_SCALE * factor))


class Trainer:
    """Solves the full model at requested grasps, each from the nearest known state. Its modulus is
    ``weights`` [tet_count, K] times ``control_young`` [K] [Pa]. ``young_tangents``: take
    derivatives to it; where it is known they would only take room in the basis."""

    def __init__(self, model: BranchModel, grasp: Grasp, weights: np.ndarray,
                 control_young: np.ndarray, *, young_tangents: bool = True):
        self.model, self.grasp = model, grasp
        self.young_tangents = young_tangents
        self.weights = weights
        self.control_young = np.asarray(control_young, float)
        self.solver = StaticSettings(max_iterations=25)
        self._rest: np.ndarray | None = None

    def solve(self, pose: np.ndarray, young: np.ndarray,
              start: np.ndarray | None = None) -> StaticResult:
        """Return the full static solution, from ``start`` or, failing that, from rest."""
        model = self.model.with_young(self.weights @ young)
        result = solve_static(model, grasp=self.grasp, pose=pose, start=start,
                              settings=self.solver)
        if not result.converged and start is not None:
            result = solve_static(model, grasp=self.grasp, pose=pose, settings=self.solver)
        return result

    def take(self, poses: np.ndarray, young: np.ndarray, known: Snapshots | None = None, *,
             vibration_every: int = 0, vibration_count: int = 0,
             progress: Progress = SILENT) -> Snapshots:
        """Solve all grasps at poses [s, 6] [m, rad] and moduli [s, K] [Pa], nearest first, and
        differentiate each. ``known`` states are starts; for vibrations see
        :class:`TrainingSettings`. ConvergenceError if none has an equilibrium."""
        starts = [] if known is None else list(zip(known.poses, known.young, known.displacement,
                                                   strict=True))
        left = list(range(len(poses)))
        rows: list[dict[str, np.ndarray]] = []
        vibrations: list[np.ndarray] = []
        swings: list[np.ndarray] = []
        owners: list[int] = []
        swung: list[int] = []
        rng = np.random.default_rng(len(poses))
        at_pose, at_young = self.grasp.rest_pose, self.control_young
        while left:
            progress(1 - len(left) / len(poses), "solving training grasps", solved=len(rows))
            far = pose_distance(self.model, poses[left], young[left], at_pose, at_young)
            number = left.pop(int(far.argmin()))
            result = self.solve(poses[number], young[number],
                                self._nearest(poses[number], young[number], starts))
            if not result.converged:
                continue
            at_pose, at_young = poses[number], young[number]
            starts.append((at_pose, at_young, result.displacement))
            tangent = self._tangent(result, at_young)
            rows.append(self._differentiated(result, at_pose, at_young, tangent))
            if vibration_every and (len(rows) - 1) % vibration_every == 0:
                modes = self._vibrations(tangent, vibration_count)
                vibrations += list(modes)
                owners += [len(rows) - 1] * len(modes)
                found = self._swings(result.displacement, modes.astype(float), at_pose, at_young,
                                     rng)
                swings += found
                swung += [len(rows) - 1] * len(found)
        if not rows:
            raise ConvergenceError(
                f"None of {len(poses)} training grasps has an equilibrium.",
                "They may be out of reach.", "Use a smaller reach, or another grasp point.")
        return self._snapshots(rows, (vibrations, owners), (swings, swung), len(poses) - len(rows))

    def differentiate(self, poses: np.ndarray, young: np.ndarray,
                      displacements: np.ndarray) -> Snapshots:
        """Return converged ``displacements`` [s, node_count, 3] [m] with their tangents."""
        rows = []
        for pose, modulus, displacement in zip(poses, young, displacements, strict=True):
            model = self.model.with_young(self.weights @ modulus)
            result = solve_static(model, grasp=self.grasp, pose=pose, start=displacement,
                                  settings=self.solver)
            rows.append(self._differentiated(result, pose, modulus,
                                             self._tangent(result, modulus)))
        return self._snapshots(rows, ([], []), ([], []), 0)

    def _snapshots(self, rows: list[dict[str, np.ndarray]],
                   vibrations: tuple[list[np.ndarray], list[int]],
                   swings: tuple[list[np.ndarray], list[int]], failed: int) -> Snapshots:
        columns = {name: np.array([row[name] for row in rows]) for name in rows[0]}
        shape = (-1, self.model.mesh.node_count, 3)
        for name, (fields, owners), kind in (("vibration", vibrations, np.float32),
                                             ("swing", swings, float)):
            columns[f"{name}s"] = np.array(fields, kind).reshape(shape)
            columns[f"{name}_states"] = np.array(owners, np.int64)
        return Snapshots(**columns, failed=failed)

    def _nearest(self, pose: np.ndarray, young: np.ndarray,
                 starts: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]],
                 ) -> np.ndarray | None:
        if not starts:
            return None
        distance = pose_distance(self.model, np.array([start[0] for start in starts]),
                                 np.array([start[1] for start in starts]), pose, young)
        return starts[int(distance.argmin())][2]

    def _tangent(self, result: StaticResult, young: np.ndarray) -> Tangent:
        model = self.model.with_young(self.weights @ young)
        return model.equations([self.grasp]).tangent(model, result.displacement)

    def _differentiated(self, result: StaticResult, pose: np.ndarray, young: np.ndarray,
                        tangent: Tangent) -> dict[str, np.ndarray]:
        model = self.model.with_young(self.weights @ young)
        u = result.displacement
        moved = [self._pose_tangent(tangent, model, u, pose, axis)
                 for axis in range(6 if self.grasp.mode == "rigid" else 3)]
        stiffer = []
        shares = zip(self.weights.T, young, strict=True) if self.young_tangents else ()
        for share, modulus in shares:
            part = share * modulus / model.young
            force = model.internal(u, lame_pair=(model.lame_lambda * part,
                                                 model.lame_mu * part)).force
            stiffer.append(tangent.solve(-force))
        return {"poses": pose, "young": young, "displacement": u,
                "energy": np.array(result.strain_energy), "force": result.reaction_force,
                "pose_tangents": np.array(moved, np.float32),
                "young_tangents": np.array(stiffer, np.float32).reshape(-1, *u.shape)}

    def _pose_tangent(self, tangent: Tangent, model: BranchModel, u: np.ndarray,
                      pose: np.ndarray, axis: int) -> np.ndarray:
        if self.grasp.mode == "point":
            return tangent.solve(np.zeros_like(u), np.eye(3)[axis][None])
        held = np.zeros_like(u)
        if axis < 3:
            held[self.grasp.nodes, axis] = 1.0
        else:
            arm = model.mesh.nodes[self.grasp.nodes] + u[self.grasp.nodes] - pose[:3]
            held[self.grasp.nodes] = np.cross(np.eye(3)[axis - 3], arm)
        return held + tangent.solve(-model.tangent_times(u, held))

    def _swings(self, state: np.ndarray, modes: np.ndarray, pose: np.ndarray, young: np.ndarray,
                rng: np.random.Generator) -> list[np.ndarray]:
        """Return states swung out from one along its vibrations, as far as motion does: bent by
        their inertia load (omega^2 M times the mode), which keeps the length of what turns far."""
        model = self.model.with_young(self.weights @ young)
        mass, found = model.mass_matrix, []
        rate = np.array([(mode * model.tangent_times(state, mode)).sum()
                         / (mode * (mass @ mode)).sum() for mode in modes])
        for _ in range(_SWING_COUNT):
            size = _SWING * model.extent * rng.uniform(-1, 1, len(modes)) * np.sqrt(
                rate.min() / rate)
            load = np.tensordot(size * rate, np.array([mass @ mode for mode in modes]), 1)
            swung = solve_static(model, grasp=self.grasp, pose=pose, nodal_forces=load,
                                 start=state, settings=self.solver)
            if swung.converged:
                found.append(swung.displacement)
        return found

    def _vibrations(self, tangent: Tangent, count: int) -> np.ndarray:
        """Lowest modes about the state of a tangent, by subspace iteration."""
        mass, n = self.model.mass_matrix, self.model.mesh.node_count
        block = np.random.default_rng(0).normal(size=(2 * count + 2, n, 3))
        for _ in range(4):
            block = np.array([tangent.solve(mass @ field) for field in block])
            heavy = np.array([mass @ field for field in block]).reshape(len(block), -1)
            gram = block.reshape(len(block), -1) @ heavy.T
            block = np.einsum("ij,jnk->ink", np.linalg.inv(np.linalg.cholesky(gram)), block)
        # The inverse's Rayleigh quotient: the largest are the lowest vibrations.
        heavy = np.array([mass @ field for field in block])
        soft = np.array([tangent.solve(field) for field in heavy])
        quotient = heavy.reshape(len(block), -1) @ soft.reshape(len(block), -1).T
        vectors = np.linalg.eigh((quotient + quotient.T) / 2)[1][:, ::-1][:, :count]
        modes = np.einsum("ij,ink->jnk", vectors, block)
        return modes / np.abs(modes).max(axis=(1, 2), keepdims=True)


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)
