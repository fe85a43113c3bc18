"""Stage ``vibration``."""

from __future__ import annotations

from itertools import repeat
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from pydantic import Field

from limber.core.errors import InputError, Option, WorkError
from limber.core.files.atomic import file_digest
from limber.core.json_values import plain
from limber.core.progress import SILENT, Progress
from limber.core.settings import Groups
from limber.stages.result import Interval, Numbers, Result, kept, shown
from limber.stages.stage import About, BranchStage, KeptStage, argument
from limber.store import Branch

if TYPE_CHECKING:
    from limber.estimation.vibration.ringing import Ringing
    from limber.mechanics.model import BranchModel
    from limber.results.report.section import Section

_MESH_DEVIATION = 0.02
"""Largest error of Young's modulus due to the mesh: quadratic tetrahedra are too stiff."""
RADIUS_SIGMA = 0.02
"""Relative standard deviation of the scan's radii as a whole."""
_CLOSE = 1.15
"""Frequency ratio within which the observed mode may be another: two bending planes."""
_ROUNDS = 8
_SLOWEST_HZ, _FASTEST_HZ = 0.05, 1000.0
"""Range of a plant branch's frequencies; outside it the record's times are in another unit."""


class Vibration(Result):
    """Young's modulus and damping of a branch by the ringing in a recording."""

    heading = "Ringing"

    young: float = shown("Young's modulus, mean of the branch", ".4g MPa")
    young_interval: Interval = kept("its 95 % interval [Pa]")
    left_over: float = shown("unexplained part of the recording", ".0f %")
    frequencies: Numbers = kept("of the vibrations in the recording [Hz]")
    frequency_deviations: Numbers = kept("their standard deviations [Hz]")
    damping_ratios: Numbers = kept("their damping ratios")
    damping_ratio_intervals: list[Interval] | None = kept("the 95 % intervals of those ratios")

    def illustrate(self, section: Section, branch: Branch, key: str) -> None:
        rows = [["frequency [Hz]", "+-", "damping", "95 % interval"]]
        intervals = [*map("{0[0]:.2f} to {0[1]:.2f} %".format,
                          (100 * ends for ends in self.damping_ratio_intervals or ()))]
        for frequency, spread, ratio, ends in zip(
                self.frequencies, self.frequency_deviations, self.damping_ratios,
                intervals or repeat(""), strict=False):
            rows.append([f"{frequency:.4g}", f"{spread:.2g}", f"{100 * ratio:.2f} %", ends])
        section.tables.append(("Vibrations in the recording", rows))


class FitVibration(KeptStage, BranchStage):
    """Estimate Young's modulus and damping from ringing (accelerometer, strain gauge, video).

    RECORD is a table of times and one or more columns of accelerations, strains or displacements in
    any unit, or a C3D file of markers. The branch is plucked and left to vibrate. Its frequencies
    determine one level of Young's modulus, as accurately as its density and radii are known; the
    pattern along the branch is kept.
    """

    about = About(
        "vibration", 76, Vibration, key="vibration", reads=("mesh.vtu",),
        writes=("vibration.json", "mesh.vtu"),
        found=("Young's modulus, mean of the branch: {young_pa:Pa} ({young_interval_pa[0]:Pa} to "
               "{young_interval_pa[1]:Pa}), from a ringing at {frequencies_hz[0]:Hz}.",),
        then="limber energy {branch_folder}", step="estimate", label="Fit Natural Frequencies")
    groups: ClassVar[Groups] = {"record": ("start", "sensor", "rate_hz")}
    common = ("sensor",)

    record: Path = argument("Table of times and readings (CSV), or C3D.")
    start: float | None = Field(None, description="Time at which the branch is released, on the "
                                "record's clock [s]. Default: where it moves most.")
    sensor: tuple[float, float, float, float] | None = Field(
        None, description="Position [m] and mass [kg] of a sensor that swings with the branch.",
        json_schema_extra={"metavar": "X Y Z KG"})
    rate_hz: float | None = Field(
        None, gt=0, description="Readings per second of the sensor. Default: by RECORD's times.")

    def run(self, progress: Progress = SILENT) -> dict[str, Any]:
        """Estimate one level of Young's modulus, and damping, from a record of free vibration.

        Writes ``vibration.json``, and the modulus into ``mesh.vtu``.

        Returns:
            ``young_pa`` (mean of the branch) with ``young_interval_pa`` (95 %) and
            ``young_factor``; ``frequencies_hz``, ``frequency_deviations_hz``, ``damping_ratios``
            and ``damping_ratio_deviations`` of the record, ``damping_ratio_intervals`` (95 %);
            ``model_frequencies_hz`` with that modulus; ``left_over``; ``damping_mass_per_s`` (0)
            and ``damping_stiffness_s``, which give the first vibration its damping.

        Raises:
            InputError: the record cannot be read, or shows no vibration.
            WorkError: no modulus has such a frequency.
        """
        from limber.estimation.vibration.ringing import identify, read_record
        from limber.store.loading import density_sigma, load_branch, load_mesh, wood_digest

        if not self.record.is_file():
            raise InputError(f"There is no file {self.record}.",
                             "A record of the branch's vibration was expected.", "Check the path.")
        rung = read_record(self.record, self.rate_hz)
        for text in rung.warnings:
            progress.warn(text)
        branch = Branch.open(self.branch_folder)
        with branch.writing("limber vibration"):
            mesh = load_mesh(branch)
            digests = {"record": file_digest(self.record),
                       "mesh geometry": mesh.geometry_digest()} | wood_digest(branch)
            if self.is_kept(branch, digests=digests):
                return branch.manifest.stages["vibration"].result
            seen = identify(rung.times, rung.values, self.start, rate_deviation=rung.rate_deviation)
            for text in seen.warnings:
                progress.warn(text)
            if not _SLOWEST_HZ < seen.frequencies[0] < _FASTEST_HZ:
                raise InputError(f"{self.record} has a first frequency of "
                                 f"{seen.frequencies[0]:.3g} Hz.",
                                 "No branch swings like that. Its times are in another unit.",
                                 "Name the unit in the title of the times: t_s, t_ms or t_us.")
            progress(0.3, "modulus of that frequency")
            model = load_branch(branch, young=mesh.cell_data.get("young"), progress=progress).model
            fitted = young_of(_with_sensor(model, self), seen, density_sigma(branch))
            young = fitted["young_factor"] * model.young
            result = _summary(seen, fitted, float(young.mean()))
            with branch.stage("vibration", self, digests=digests) as stage:
                stage.write("vibration.json", result)
                mesh.with_data(cell_data={"young": young, "poisson": model.poisson,
                                          "density": model.density}).write(stage.path("mesh.vtu"))
                stage.result.update(result)
            return stage.result


def young_of(model: BranchModel, seen: Ringing, density_sigma: float) -> dict[str, Any]:
    """Return the factor on the modulus for which a model has the record's first frequency:
    ``young_factor``, ``deviation`` (of its logarithm), ``model_frequencies_hz``. WorkError if there
    is none."""
    from limber.mechanics.dynamics.motion import lowest_modes

    target, factor, last = float(seen.frequencies[0]), 1.0, None
    for _ in range(_ROUNDS):
        found = lowest_modes(model.with_young(factor * model.young), 3).frequencies
        log_ratio = np.log(target / found[0])
        if abs(log_ratio) < 1e-5:
            break
        # Weight also stiffens or softens a branch: the slope is not exactly one half.
        slope = 0.5 if last is None else np.clip(
            (np.log(found[0]) - last[1]) / (np.log(factor) - last[0]), 0.1, 2.0)
        last = np.log(factor), np.log(found[0])
        factor *= float(np.exp(log_ratio / slope))
    else:
        raise WorkError(f"No modulus gives the branch a first frequency of {target:.3g} Hz.",
                        "The branch's mass, or what hangs on it, does not match the record.",
                        "Check density, ", Option("sensor"), " and the record's unit of time.")
    slope = 0.5 if last is None else slope
    near = found[found < _CLOSE * found[0]]
    # The observed plane of bending is unknown if the record does not separate the two.
    is_parted = len(seen.frequencies) > 1 and seen.frequencies[1] < _CLOSE * target
    planes = 0.0 if is_parted else float(np.log(near[-1] / near[0])) / np.sqrt(3.0)
    deviation = np.sqrt((seen.frequency_deviations[0] / target / slope) ** 2
                        + (planes / slope) ** 2 + density_sigma**2
                        + (2 * RADIUS_SIGMA) ** 2 + _MESH_DEVIATION**2)
    return {"young_factor": factor, "deviation": float(deviation), "model_frequencies_hz": found}


def _with_sensor(model: BranchModel, settings: FitVibration) -> BranchModel:
    from limber.mechanics.added_masses import PointMass

    if settings.sensor is None:
        return model
    x, y, z, mass = settings.sensor
    away = float(np.linalg.norm(model.mesh.nodes - np.array([x, y, z]), axis=1).min())
    if not (mass > 0 and away < 0.1):
        raise InputError(f"A sensor of {mass:g} kg lies {1e3 * away:.0f} mm off the branch.",
                         "A sensor needs a mass and a position on the "
                         "branch.", "Check ", Option("sensor"), " X Y Z KG.")
    return model.with_point_masses([*model.point_masses, PointMass((x, y, z), mass)])


def _summary(seen: Ringing, fitted: dict[str, Any], level: float) -> dict[str, Any]:
    spread = 1.96 * fitted["deviation"]
    omega = 2 * np.pi * seen.frequencies[0]
    return plain({
        "young_pa": level, "young_interval_pa": [level * np.exp(-spread), level * np.exp(spread)],
        "young_factor": fitted["young_factor"], "young_deviation": fitted["deviation"],
        "frequencies_hz": seen.frequencies, "frequency_deviations_hz": seen.frequency_deviations,
        "damping_ratios": seen.damping, "damping_ratio_deviations": seen.damping_deviations,
        "damping_ratio_intervals": seen.damping_intervals,
        "model_frequencies_hz": fitted["model_frequencies_hz"], "left_over": seen.left_over,
        "damping_mass_per_s": 0.0, "damping_stiffness_s": float(2 * seen.damping[0] / omega),
        "start_s": seen.start, "duration_s": seen.duration})
