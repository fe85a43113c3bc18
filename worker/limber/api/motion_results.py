"""Results of simulated motions and loads."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from limber.api.result import Result, columns_of, drawn, frozen, yes_or_no
from limber.core.files.reading import read_json
from limber.store import Branch as Folder

if TYPE_CHECKING:
    from matplotlib.figure import Figure



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
        return cls(MappingProxyType({**values}), name, frozen(frames.times_s),
                   frozen(frames.energies_j), frozen(frames.kinetic_energies_j),
                   frozen(frames.grasp_forces_n), frozen(frames.largest_principal_strains),
                   read_pc2(branch.path(f"frames/{name}.pc2"))[0], values["converged"])

    def table(self) -> dict[str, np.ndarray]:
        """Return ``time_s``, ``energy_j``, ``kinetic_energy_j``, ``fx_n`` ... and ``strain``."""
        return {"time_s": self.times, "energy_j": self.energies,
                "kinetic_energy_j": self.kinetic_energies,
                **columns_of(self.forces, "fx_n", "fy_n", "fz_n"), "strain": self.strains}

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
                "largest strain": f"{self.strains.max():.4g}",
                "converged": yes_or_no(self.converged)}


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
                   frozen(values["sag_interval_m"] or [np.nan, np.nan]),
                   values["greatest_strain"], values["strain_over_limit"],
                   frozen(values["frequencies_hz"]), frozen(values["frequencies_before_hz"]),
                   frozen(values["tip_displacement_m"]), frozen(values["wind_force_n"]),
                   values.get("bears_times"), values["along"])

    def table(self) -> dict[str, np.ndarray]:
        """Return the greatest strain along the main path: ``from_m``, ``to_m``, ``strain``."""
        return {name: frozen([row[name] for row in self._along])
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
