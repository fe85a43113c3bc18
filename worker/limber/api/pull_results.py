"""Results of generated scans, pulls and estimates."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from limber.api.result import Result, columns_of, drawn, frozen, pose_columns, yes_or_no
from limber.store import Branch as Folder

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from limber.recordings.recording import Pull as Recording


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
        return cls(MappingProxyType({**values}), Path(values["cloud"]), frozen(values["young_pa"]))

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
        return cls(MappingProxyType({**values}), found.name, frozen(found.times),
                   frozen(found.poses), frozen(found.wrenches[:, :3]),
                   frozen(found.wrenches[:, 3:]), frozen([] if seen is None else seen.times),
                   frozen(np.empty((0, 0, 3)) if seen is None else seen.positions), found)

    def table(self) -> dict[str, np.ndarray]:
        """Return the columns ``time_s``, ``x_m`` ... ``rz_rad``, ``fx_n`` ... ``tz_nm``."""
        return {"time_s": self.times, **pose_columns(self.poses),
                **columns_of(self.forces, "fx_n", "fy_n", "fz_n"),
                **columns_of(self.torques, "tx_nm", "ty_nm", "tz_nm")}

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
        bending_stiffness: E times the second moment of area [N m^2], the latter a mean over each
            control point's section by strain energy, shape [K]; NaN in a folder of an earlier
            version.
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
        return cls(MappingProxyType({**values}), frozen(content["young_pa"]),
                   frozen(content["young_interval_pa"]),
                   frozen(content.get("bending_stiffness_nm2") or [np.nan] * count),
                   frozen(content.get("bending_stiffness_interval_nm2") or [[np.nan] * 2] * count),
                   frozen(content["fractions"]),
                   frozen(content["control_points_m"]), content["poisson"],
                   float(frozen(content["loss_m2"])), content["converged"], content)

    def table(self) -> dict[str, np.ndarray]:
        """Return the columns ``fraction``, ``young_pa``, ``low_pa``, ``high_pa``, ``ei_nm2``,
        ``ei_low_nm2`` and ``ei_high_nm2``.
        """
        return {"fraction": self.fractions, "young_pa": self.young,
                **columns_of(self.interval, "low_pa", "high_pa"), "ei_nm2": self.bending_stiffness,
                **columns_of(self.bending_interval, "ei_low_nm2", "ei_high_nm2")}

    def plot(self) -> "Figure":
        """Draw Young's modulus along the branch with its interval, and the truth if known."""
        from limber.results.report.estimate_figures import young_along_branch

        return drawn(lambda: young_along_branch(self._content))

    def _shown(self) -> dict[str, str]:
        moduli = zip(1e-6 * self.young, 1e-6 * self.interval, strict=True)
        return {"E [MPa]": "; ".join(f"{young:.4g} ({low:.4g} to {high:.4g})"
                                     for young, (low, high) in moduli),
                "Poisson's ratio": f"{self.poisson:.3f}", "loss": f"{self.loss:.3g} m2",
                "converged": yes_or_no(self.converged)}
