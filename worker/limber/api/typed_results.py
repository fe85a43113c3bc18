"""The results of the verbs: frozen, with units; they print, draw and become tables.

Arrays are read-only. ``table()`` gives columns by name, as ``pandas.DataFrame(...)`` takes them;
``plot()`` gives a figure of matplotlib, which a notebook shows and ``savefig`` writes.
"""

import functools
import html
import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from limber.core.errors import InputError
from limber.core.files.reading import read_json
from limber.core.optional import require_extra
from limber.store import Branch as Folder

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from limber.planning.constraints.damage_along import DamageAlong
    from limber.planning.field.energy_field import EnergyField as FittedField
    from limber.planning.plan_file import PlanFile
    from limber.recordings.recording import Pull as Recording

_MOST_PRINTED = 7  # values printed in one line; the notebook's table shows all


@dataclass(frozen=True, repr=False, eq=False)
class Result:
    """Result of a stage.

    Attributes:
        values: The output of its command with ``--json``, in SI units that the names contain.

    >>> limber.open("a.branch").results["reconstruct"].values["watertight"]
    True
    """

    values: Mapping[str, Any]

    @classmethod
    def read(cls, branch: Folder, key: str, values: Mapping[str, Any]) -> "Result":
        """Return the result of an entry ``key`` of a branch's manifest, including its files."""
        return cls(MappingProxyType({**values}))

    @property
    def warnings(self) -> tuple[str, ...]:
        """The warnings of the stage."""
        return tuple(self.values.get("warnings", ()))

    def _shown(self) -> dict[str, str]:
        """The printed values, by label."""
        return {name: f"{value:.4g}" if isinstance(value, float) else str(value)
                for name, value in self.values.items() if isinstance(value, bool | int | float)}

    def __repr__(self) -> str:
        parts = [f"{label} {text}" for label, text in self._shown().items()]
        if len(parts) > _MOST_PRINTED:
            parts[_MOST_PRINTED:] = ["..."]
        return f"{type(self).__name__}({', '.join(parts)})"

    def _repr_html_(self) -> str:
        rows = "".join(f"<tr><td>{html.escape(label)}</td><td>{html.escape(text)}</td></tr>"
                       for label, text in self._shown().items())
        return f"<table><caption>{type(self).__name__}</caption>{rows}</table>"


@dataclass(frozen=True, repr=False, eq=False)
class Generated(Result):
    """A branch with known truth, and its scan.

    Attributes:
        cloud: The scan, for :func:`limber.reconstruct`.
        young: True Young's modulus at the control points [Pa], shape [K].

    >>> limber.generate("made", length=0.3, fork_count=0, seed=1).young.shape
    (4,)
    """

    cloud: Path
    young: np.ndarray

    @classmethod
    def read(cls, branch: Folder | None, key: str, values: Mapping[str, Any]) -> "Generated":
        return cls(MappingProxyType({**values}), Path(values["cloud"]), _array(values["young_pa"]))

    def _shown(self) -> dict[str, str]:
        return {"points": f"{self.values['point_count']:,}",
                "length": f"{self.values['length_m']:.3f} m",
                "branches": str(self.values["branch_count"]), "scan": str(self.cloud)}


@dataclass(frozen=True, repr=False, eq=False)
class Pull(Result):
    """A recording of force and motion.

    Attributes:
        name: Name of the pull.
        times: [s], shape [n].
        poses: Poses of the grasp: position [m], rotation vector [rad], shape [n, 6].
        forces: Forces of the gripper on the branch [N], shape [n, 3]; NaN if not measured.
        torques: Likewise [N m], shape [n, 3].
        marker_times: [s], shape [k]; empty if there are no markers.
        markers: Positions of the observed points [m], shape [k, points, 3]; NaN if not observed.

    >>> pull = limber.open("a.branch").pulls["pull-1"]
    >>> pull.table()["fx_n"].shape == pull.times.shape
    True
    """

    name: str
    times: np.ndarray
    poses: np.ndarray
    forces: np.ndarray
    torques: np.ndarray
    marker_times: np.ndarray
    markers: np.ndarray
    _recording: "Recording"

    @classmethod
    def read(cls, branch: Folder, key: str, values: Mapping[str, Any]) -> "Pull":
        from limber.recordings.recording import read_pull

        found = read_pull(branch.path(f"pulls/{key.partition(':')[2]}"))
        seen = found.observations
        return cls(MappingProxyType({**values}), found.name, _array(found.times),
                   _array(found.poses), _array(found.wrenches[:, :3]),
                   _array(found.wrenches[:, 3:]), _array([] if seen is None else seen.times),
                   _array(np.empty((0, 0, 3)) if seen is None else seen.positions), found)

    def table(self) -> dict[str, np.ndarray]:
        """Return the columns ``time_s``, ``x_m`` ... ``rz_rad``, ``fx_n`` ... ``tz_nm``."""
        return {"time_s": self.times, **_pose_columns(self.poses),
                **_columns(self.forces, "fx_n", "fy_n", "fz_n"),
                **_columns(self.torques, "tx_nm", "ty_nm", "tz_nm")}

    def plot(self) -> "Figure":
        """Draw force on the branch and displacement of the grasp over time."""
        from limber.results.report import figures

        return drawn(lambda: figures.pull(self._recording))

    def _shown(self) -> dict[str, str]:
        force = np.linalg.norm(self.forces, axis=1)
        travel = np.linalg.norm(self.poses[:, :3] - self.poses[0, :3], axis=1).max()
        peak = f"{np.nanmax(force):.3g} N" if np.isfinite(force).any() else "not measured"
        return {"name": self.name, "frames": str(len(self.times)),
                "duration": f"{np.ptp(self.times):.3g} s", "way": f"{1e3 * travel:.3g} mm",
                "peak force": peak}


@dataclass(frozen=True, repr=False, eq=False)
class Estimate(Result):
    """Young's modulus along the branch.

    Attributes:
        young: At the control points [Pa], shape [K].
        interval: Its 95 % interval [Pa], shape [K, 2]; NaN if an end is open.
        bending_stiffness: E times the second moment of area, mean over each control point's section
            of the branch [N m^2], shape [K]; NaN in a folder of an earlier version.
        bending_interval: Its 95 % interval [N m^2], shape [K, 2]: narrower than that of E if the
            scan leaves the radius uncertain.
        fractions: Positions of the control points on the main path, 0 base to 1 tip, shape [K].
        control_points: [m], branch frame, shape [K, 3].
        poisson: Poisson's ratio.
        loss: The paper's loss J [m^2].
        converged: Whether the fit ended at a solution.

    >>> found = limber.open("a.branch").results["estimate"]
    >>> found.young.shape, found.interval.shape, found.converged
    ((4,), (4, 2), True)
    """

    young: np.ndarray
    interval: np.ndarray
    bending_stiffness: np.ndarray
    bending_interval: np.ndarray
    fractions: np.ndarray
    control_points: np.ndarray
    poisson: float
    loss: float
    converged: bool
    _content: dict[str, Any]

    @classmethod
    def read(cls, branch: Folder, key: str, values: Mapping[str, Any]) -> "Estimate":
        from limber.estimation.estimate_file import read_estimate

        content = read_estimate(branch.path("estimate.json"))
        count = len(content["young_pa"])
        return cls(MappingProxyType({**values}), _array(content["young_pa"]),
                   _array(content["young_interval_pa"]),
                   _array(content.get("bending_stiffness_nm2") or [np.nan] * count),
                   _array(content.get("bending_stiffness_interval_nm2") or [[np.nan] * 2] * count),
                   _array(content["fractions"]),
                   _array(content["control_points_m"]), content["poisson"],
                   float(_array(content["loss_m2"])), content["converged"], content)

    def table(self) -> dict[str, np.ndarray]:
        """Return the columns ``fraction``, ``young_pa``, ``low_pa``, ``high_pa``, ``ei_nm2``,
        ``ei_low_nm2`` and ``ei_high_nm2``.
        """
        return {"fraction": self.fractions, "young_pa": self.young,
                **_columns(self.interval, "low_pa", "high_pa"), "ei_nm2": self.bending_stiffness,
                **_columns(self.bending_interval, "ei_low_nm2", "ei_high_nm2")}

    def plot(self) -> "Figure":
        """Draw Young's modulus along the branch with its interval, and the truth if known."""
        from limber.results.report.estimate_figures import young_along_branch

        return drawn(lambda: young_along_branch(self._content))

    def _shown(self) -> dict[str, str]:
        moduli = zip(1e-6 * self.young, 1e-6 * self.interval, strict=True)
        return {"E [MPa]": "; ".join(f"{young:.4g} ({low:.4g} to {high:.4g})"
                                     for young, (low, high) in moduli),
                "Poisson's ratio": f"{self.poisson:.3f}", "loss": f"{self.loss:.3g} m2",
                "converged": _yes(self.converged)}


@dataclass(frozen=True, repr=False, eq=False)
class Simulation(Result):
    """A simulated motion, frame by frame.

    Attributes:
        name: Name of its files.
        times: [s], shape [n].
        energies: Strain energy [J], shape [n].
        kinetic_energies: [J], shape [n].
        forces: Forces of the gripper on the branch [N], shape [n, 3].
        strains: Largest principal strain in the branch, shape [n].
        positions: Positions of the surface's vertices [m], shape [n, vertices, 3], single
        precision.
        converged: Whether the branch followed to the end.

    >>> bent = limber.open("a.branch").simulate(move=(0.005, 0, 0), kind="static", duration=0.1)
    >>> bent.positions.shape[::2] == (len(bent.times), 3)
    True
    """

    name: str
    times: np.ndarray
    energies: np.ndarray
    kinetic_energies: np.ndarray
    forces: np.ndarray
    strains: np.ndarray
    positions: np.ndarray
    converged: bool

    @classmethod
    def read(cls, branch: Folder, key: str, values: Mapping[str, Any]) -> "Simulation":
        from limber.results.motion_files import read_frames_file, read_pc2

        name = branch.manifest.stages[key].settings["name"]
        frames = read_frames_file(branch.path(f"frames/{name}.json"))
        return cls(MappingProxyType({**values}), name, _array(frames.times_s),
                   _array(frames.energies_j), _array(frames.kinetic_energies_j),
                   _array(frames.grasp_forces_n), _array(frames.largest_principal_strains),
                   read_pc2(branch.path(f"frames/{name}.pc2"))[0], values["converged"])

    def table(self) -> dict[str, np.ndarray]:
        """Return ``time_s``, ``energy_j``, ``kinetic_energy_j``, ``fx_n`` ... and ``strain``."""
        return {"time_s": self.times, "energy_j": self.energies,
                "kinetic_energy_j": self.kinetic_energies,
                **_columns(self.forces, "fx_n", "fy_n", "fz_n"), "strain": self.strains}

    def plot(self) -> "Figure":
        """Draw energies and the gripper's force over time."""
        from limber.results.report import figures

        return drawn(lambda: figures.motion({
            "times_s": self.times, "energies_j": self.energies,
            "kinetic_energies_j": self.kinetic_energies, "grasp_forces_n": self.forces}))

    def _shown(self) -> dict[str, str]:
        return {"name": self.name, "frames": str(len(self.times)),
                "final energy": f"{self.energies[-1]:.4g} J",
                "final force": f"{np.linalg.norm(self.forces[-1]):.4g} N",
                "largest strain": f"{self.strains.max():.4g}", "converged": _yes(self.converged)}


@dataclass(frozen=True, repr=False, eq=False)
class Load(Result):
    """Effects of wind, snow, fruit or a cut on the branch.

    Attributes:
        sag: Downward displacement of the tip [m].
        sag_interval: Its 95 % interval [m], shape [2]; NaN if the uncertainty of E is unknown.
        greatest_strain: Largest principal strain.
        strain_over_limit: That strain over the strain at which the wood is assumed to fail.
        frequencies: Lowest natural frequencies under the loads [Hz].
        frequencies_before: Those without the loads [Hz].
        tip_displacement: [m], shape [3].
        wind_force: Force on the whole branch [N], shape [3].
        bears_times: Factor on the loads that the branch bears; None if it was not requested.

    >>> found = limber.open("a.branch").load(snow=2.0)
    >>> bool(found.frequencies[0] < found.frequencies_before[0]), found.bears_times is None
    (True, True)
    """

    sag: float
    sag_interval: np.ndarray
    greatest_strain: float
    strain_over_limit: float
    frequencies: np.ndarray
    frequencies_before: np.ndarray
    tip_displacement: np.ndarray
    wind_force: np.ndarray
    bears_times: float | None
    _along: list[dict[str, float]] = field(default_factory=list)

    @classmethod
    def read(cls, branch: Folder, key: str, values: Mapping[str, Any]) -> "Load":
        name = key.partition(":")[2]
        if "along" not in values:
            values = read_json(branch.path(f"loads/{name}.json"), "the effects of loads")
        return cls(MappingProxyType({**values}), values["sag_m"],
                   _array(values["sag_interval_m"] or [np.nan, np.nan]),
                   values["greatest_strain"], values["strain_over_limit"],
                   _array(values["frequencies_hz"]), _array(values["frequencies_before_hz"]),
                   _array(values["tip_displacement_m"]), _array(values["wind_force_n"]),
                   values.get("bears_times"), values["along"])

    def table(self) -> dict[str, np.ndarray]:
        """Return the greatest strain along the main path: ``from_m``, ``to_m``, ``strain``."""
        return {name: _array([row[name] for row in self._along])
                for name in ("from_m", "to_m", "strain")}

    def plot(self) -> "Figure":
        """Draw the greatest strain along the main path."""
        from limber.results.report.loads_section import strain_along_path

        return drawn(lambda: strain_along_path(**self.table()))

    def _shown(self) -> dict[str, str]:
        low, high = 1e3 * self.sag_interval
        between = "" if np.isnan(low) else f" ({low:.4g} to {high:.4g})"
        texts = {"sag": f"{1e3 * self.sag:.4g}{between} mm",
                 "largest strain": f"{self.greatest_strain:.4g}",
                 "fraction of the limit": f"{100 * self.strain_over_limit:.3g} %",
                 "first frequency": f"{self.frequencies[0]:.4g} Hz"}
        return texts if self.bears_times is None else texts | {
            "bears": f"{self.bears_times:.3g} times the loads"}


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
        return cls(MappingProxyType({**values}), _array(samples.positions),
                   _array(samples.energies), _array(samples.forces), values["energy_error"],
                   values["force_error"], fitted)

    def energy(self, points: np.ndarray) -> np.ndarray:
        """Return the energy [J] with the grasp at ``points`` [m], shape [n, 3]; shape [n]."""
        return self._field.energy(np.asarray(points, float))

    def force(self, points: np.ndarray) -> np.ndarray:
        """Return the gripper's force [N] with the grasp at ``points`` [m], both [n, 3]."""
        return self._field.force(np.asarray(points, float))

    def table(self) -> dict[str, np.ndarray]:
        """Return the samples: ``x_m``, ``y_m``, ``z_m``, ``energy_j``, ``fx_n`` ..."""
        return {**_columns(self.positions, "x_m", "y_m", "z_m"), "energy_j": self.energies,
                **_columns(self.forces, "fx_n", "fy_n", "fz_n")}

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
        from limber.planning.constraints.damage_along import DamageAlong
        from limber.planning.field.energy_field import EnergyField as FittedField
        from limber.planning.plan_file import read_plan

        name = key.partition(":")[2]
        damage = branch.path(f"plans/{name}-damage.csv")
        found = read_plan(branch.path(f"plans/{name}.json"))
        path, proof = found.plan, values["certificate"]
        return cls(MappingProxyType({**values}), name, _array(path.poses), _array(path.times),
                   _array(path.energies), _array(path.forces), _array(path.strains),
                   _array(found.baseline.poses), values["plan"]["energy_integral_jm"],
                   values["energy_saved_percent"], float(_array(proof["upper_bound"])),
                   proof["lower_bound"], proof["gap_percent"], found,
                   FittedField.read(branch.path("energy.npz")), DamageAlong.read(damage)
                   if branch.has(f"plans/{name}-damage.csv") else None)

    def table(self) -> dict[str, np.ndarray]:
        """Return the gentle path: ``time_s``, ``x_m`` ... ``rz_rad``, ``energy_j``, ``fx_n`` ...
        and ``strain``."""
        return {"time_s": self.times, **_pose_columns(self.path), "energy_j": self.energies,
                **_columns(self.forces, "fx_n", "fy_n", "fz_n"), "strain": self.strains}

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
        texts = {"plan": self.name, "armed": _yes(self.armed), "reached": _yes(self.reached)}
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


_KINDS: dict[str, type[Result]] = {
    "energy": EnergyField, "estimate": Estimate, "execute": Execution, "load": Load,
    "plan": Plan, "pull": Pull, "record": Pull, "replay": Simulation, "simulate": Simulation}


def read_result(branch: Folder, key: str, values: Mapping[str, Any]) -> Result:
    """Return the typed result of an entry of a branch's manifest.

    Args:
        key: The entry's name, such as ``plan:to-light``.
        values: The stage's result.
    """
    return _KINDS.get(key.partition(":")[0], Result).read(branch, key, values)


def _array(values: Any) -> np.ndarray:
    """A copy that cannot be written to; JSON's null is NaN."""
    made = np.array(values, float)
    made.setflags(write=False)
    return made


def _columns(values: np.ndarray, *names: str) -> dict[str, np.ndarray]:
    return dict(zip(names, values.T, strict=True))


def _pose_columns(poses: np.ndarray) -> dict[str, np.ndarray]:
    return _columns(poses, "x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad")


def _yes(value: bool) -> str:
    return "yes" if value else "no"


def drawn(draw: "Callable[[], Figure]") -> "Figure":
    """Draw a figure that a notebook shows once, regardless of its figure settings."""
    require_extra("report", ("matplotlib",), "A picture")
    import matplotlib.pyplot as plt

    figure = draw()
    # An open figure is shown when the cell ends, and again as the value of the cell.
    plt.close(figure)
    vars(figure)["_repr_png_"] = functools.partial(_png, figure)
    return figure


def _png(figure: "Figure") -> bytes:
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=100, bbox_inches="tight")
    return stream.getvalue()
