"""Results of energy fields, plans and executions, and written files."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from limber.api.result import Result, columns_of, drawn, frozen, pose_columns, yes_or_no
from limber.core.errors import InputError
from limber.store import Branch as Folder

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from limber.planning.constraints.damage import DamageAlong
    from limber.planning.field.energy_field import EnergyField as FittedField
    from limber.planning.plan_file import PlanFile


@dataclass(frozen=True, repr=False, eq=False)
class EnergyField(Result):
    """Deformation energy over the position of the grasp.

    Attributes:
        positions: Sampled positions of the grasp [m], shape [m, 3]; the first is at rest.
        energies: Potential of strain and weight above the rest shape there [J], shape [m].
        forces: Forces of the gripper on the branch there [N], shape [m, 3].
        energy_error: Root mean square error over that of the energy, for samples outside the fit.
        force_error: Likewise of the force.

    >>> field = limber.open("a.branch").results["energy"]
    >>> field.energy(field.positions[:2]).shape, bool(field.energy_error < 0.1)
    ((2,), True)
    """

    positions: np.ndarray
    energies: np.ndarray
    forces: np.ndarray
    energy_error: float
    force_error: float
    _field: "FittedField"

    @classmethod
    def read(cls, branch: Folder, key: str, values: Mapping[str, Any]) -> "EnergyField":
        from limber.planning.field.energy_field import EnergyField as FittedField

        fitted = FittedField.read(branch.path("energy.npz"))
        samples = fitted.samples
        return cls(MappingProxyType({**values}), frozen(samples.positions),
                   frozen(samples.energies), frozen(samples.forces), values["energy_error"],
                   values["force_error"], fitted)

    def energy(self, points: np.ndarray) -> np.ndarray:
        """Return the energy [J] with the grasp at ``points`` [m], shape [n, 3]; shape [n]."""
        return self._field.energy(np.asarray(points, float))

    def force(self, points: np.ndarray) -> np.ndarray:
        """Return the gripper's force [N] with the grasp at ``points`` [m], both [n, 3]."""
        return self._field.force(np.asarray(points, float))

    def table(self) -> dict[str, np.ndarray]:
        """Return the samples: ``x_m``, ``y_m``, ``z_m``, ``energy_j``, ``fx_n`` ..."""
        return {**columns_of(self.positions, "x_m", "y_m", "z_m"), "energy_j": self.energies,
                **columns_of(self.forces, "fx_n", "fy_n", "fz_n")}

    def plot(self) -> "Figure":
        """Draw energy and force of the samples over their distance from rest."""
        from limber.results.report import figures

        return drawn(lambda: figures.energy_samples({
            "rest_pose": self.positions[0], "poses": self.positions,
            "energies_j": self.energies, "forces_n": self.forces}))

    def _shown(self) -> dict[str, str]:
        return {"samples": str(len(self.positions)),
                "rejected": str(self.values["rejected_count"]),
                "largest energy": f"{self.energies.max():.4g} J",
                "error": f"{100 * self.energy_error:.2g} % of the energy, "
                          f"{100 * self.force_error:.2g} % of the force"}


@dataclass(frozen=True, repr=False, eq=False)
class Plan(Result):
    """A gentle path of the grasp and the shortest one, both computed with the full model.

    Attributes:
        name: Name of its files.
        path: Poses along the gentle path: position [m], rotation vector [rad], shape [n, 6].
        times: [s], shape [n].
        energies: Above the rest shape [J], shape [n].
        forces: Forces of the gripper on the branch [N], shape [n, 3].
        strains: Largest strain in the branch, shape [n].
        shortest_path: Poses along the shortest path, shape [k, 6].
        energy: Energy integrated along the gentle path [J m].
        energy_saved: Relative to the shortest path [%].
        cost: Cost of the gentle path on the energy field, dimensionless: the planner weighs energy
            and length, each over its scale. With a ``max_detour``: the energy along it [J m].
        bound: Lower bound of the cost of any path, dimensionless or [J m] as the cost: the
        certificate.
        gap: Largest cost of the gentle path above that of the best one [%]; None if unknown.

    >>> plan = limber.open("a.branch").results["plan:to-goal"]
    >>> plan.path.shape[1], plan.bound <= plan.cost
    (6, True)
    """

    name: str
    path: np.ndarray
    times: np.ndarray
    energies: np.ndarray
    forces: np.ndarray
    strains: np.ndarray
    shortest_path: np.ndarray
    energy: float
    energy_saved: float | None
    cost: float
    bound: float
    gap: float | None
    _file: "PlanFile"
    _field: "FittedField"
    _damage: "DamageAlong | None"

    @classmethod
    def read(cls, branch: Folder, key: str, values: Mapping[str, Any]) -> "Plan":
        from limber.planning.constraints.damage import DamageAlong
        from limber.planning.field.energy_field import EnergyField as FittedField
        from limber.planning.plan_file import read_plan

        name = key.partition(":")[2]
        damage = branch.path(f"plans/{name}-damage.csv")
        found = read_plan(branch.path(f"plans/{name}.json"))
        path, proof = found.plan, values["certificate"]
        return cls(MappingProxyType({**values}), name, frozen(path.poses), frozen(path.times),
                   frozen(path.energies), frozen(path.forces), frozen(path.strains),
                   frozen(found.baseline.poses), values["plan"]["energy_integral_jm"],
                   values["energy_saved_percent"], float(frozen(proof["upper_bound"])),
                   proof["lower_bound"], proof["gap_percent"], found,
                   FittedField.read(branch.path("energy.npz")), DamageAlong.read(damage)
                   if branch.has(f"plans/{name}-damage.csv") else None)

    def table(self) -> dict[str, np.ndarray]:
        """Return the gentle path: ``time_s``, ``x_m`` ... ``rz_rad``, ``energy_j``, ``fx_n`` ...
        and ``strain``."""
        return {"time_s": self.times, **pose_columns(self.path), "energy_j": self.energies,
                **columns_of(self.forces, "fx_n", "fy_n", "fz_n"), "strain": self.strains}

    def plot(self) -> "Figure":
        """Draw both paths over a slice of the energy field."""
        from limber.results.report.plan_figures import paths_over_slice

        return drawn(lambda: paths_over_slice(self._field, self._file))

    def plot_damage(self) -> "Figure":
        """Draw where along the branch the gentle path would damage it, and how probably.

        Raises:
            InputError: the plan is of a version that did not compute it.
        """
        from limber.results.report.damage_figure import damage_along_branch

        if self._damage is None:
            raise InputError(f"The plan {self.name} has no strains along the branch.",
                             "An older version of Limber made it.", "Plan again with force=True.")
        damage = self._damage
        return drawn(lambda: damage_along_branch(damage))

    def plot_along(self) -> "Figure":
        """Draw energy, force and strain over the length of both paths."""
        from limber.results.report.plan_figures import along_paths

        return drawn(lambda: along_paths(self._file))

    def _shown(self) -> dict[str, str]:
        saved, gap = self.energy_saved, self.gap
        return {"name": self.name, "length": f"{1e3 * self.values['plan']['length_m']:.1f} mm",
                "energy": f"{self.energy:.3g} J m",
                "saved": "not known" if saved is None else f"{saved:.1f} %",
                "peak force": f"{self.values['plan']['peak_force_n']:.3g} N",
                "cost above the best path, at most": "not known" if gap is None else f"{gap:.2g} %"}


@dataclass(frozen=True, repr=False, eq=False)
class Execution(Result):
    """The execution of a plan by a robot, or the results of the dry run.

    Attributes:
        name: Name of the plan.
        armed: Whether the robot moved; otherwise it was a dry run.
        reached: Whether it reached the path's end and returned.
        stop_reason: Reason for the stop; None if it was not stopped.
        peak_force: Largest measured force [N]; None in a dry run.
        path_error: Largest distance from the path [m]; None in a dry run.

    >>> limber.open("a.branch").execute("cell.toml", name="to-goal").reached  # doctest: +SKIP
    False
    """

    name: str
    armed: bool
    reached: bool
    stop_reason: str | None
    peak_force: float | None
    path_error: float | None
    _log: Path

    @classmethod
    def read(cls, branch: Folder, key: str, values: Mapping[str, Any]) -> "Execution":
        name = key.partition(":")[2]
        return cls(MappingProxyType({**values}), name, values["armed"], values["reached"],
                   values["stop_reason"], values["peak_force_n"], values["path_error_m"],
                   branch.path(f"executions/{name}/samples.csv"))

    def plot(self) -> "Figure":
        """Draw the measured force and the predicted one.

        Raises:
            InputError: the robot did not move.
        """
        from limber.results.report.execution_section import force_along_path

        return drawn(lambda: force_along_path(self._log))

    def _shown(self) -> dict[str, str]:
        texts = {"plan": self.name, "armed": yes_or_no(self.armed),
                 "reached": yes_or_no(self.reached)}
        if self.stop_reason:
            texts["stopped"] = self.stop_reason
        if self.peak_force is not None:
            texts["peak force"] = f"{self.peak_force:.3g} N"
        return texts


@dataclass(frozen=True, repr=False, eq=False)
class Written(Result):
    """A written file.

    Attributes:
        path: Path of the file.

    >>> limber.open("a.branch").export("a.swc").path.suffix
    '.swc'
    """

    path: Path

    def _shown(self) -> dict[str, str]:
        return {"path": str(self.path)}
