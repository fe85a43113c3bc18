"""Stage ``swing``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from limber.core.errors import Command, InputError, Option, Text, WorkError
from limber.core.files.reading import read_json
from limber.core.json_values import number_array
from limber.core.not_none import present
from limber.core.progress import SILENT, Progress
from limber.estimation.settings import FitSpec, SwingSettings
from limber.stages.result import Interval, Picture, Result, frozen, kept, of_files, shown
from limber.stages.stage import About, BranchStage, KeptStage
from limber.store import Branch

if TYPE_CHECKING:
    from limber.estimation.vibration.free_swing import SwingFit
    from limber.recordings.recording import Pull
    from limber.results.report.section import Section


class Swing(Result):
    """Young's modulus and damping of a branch by a free swing."""

    heading = "Swing"
    pictures = (Picture("figures.swing_over_time", "Displacement of the marker that swings "
                        "most, along its path: observed (dots) and simulated.",
                        ("times", "seen", "simulated")),)

    young: float = shown("Young's modulus, mean", ".4g MPa")
    young_interval: Interval = kept("its 95 % interval [Pa]")
    damping_ratio: float = shown("damping ratio of the first vibration", ".3g")
    damping_ratio_interval: Interval = kept("its 95 % interval, a ratio")
    release: float = shown("time of release", ".4g s")
    release_deviation: float = shown("its standard deviation", ".2g s")
    frequency: float = shown("first frequency", ".4g Hz")
    relative_residual: float = shown("residual relative to the largest displacement", ".2g %")
    times: np.ndarray = of_files("[s], shape [n]")
    seen: np.ndarray = of_files("displacements of the markers [m], shape [n, markers, 3]; NaN "
                                "where not observed")
    simulated: np.ndarray = of_files("those of the fit [m], shape [n, markers, 3]")

    def of_folder(self, branch: Branch, key: str) -> dict[str, Any]:
        path = branch.path("swing.json")
        content = read_json(path, "the result of a swing")
        try:
            found = {name: number_array(content[f"{name}_{unit}"], gaps=name == "seen")
                     for name, unit in (("times", "s"), ("seen", "m"), ("simulated", "m"))}
        except (LookupError, TypeError, ValueError) as error:
            raise InputError(f"{path} has no tracks of markers.", *_DAMAGED) from error
        shape = found["simulated"].shape
        if (len(shape) != 3 or shape[2] != 3 or not shape[1] or found["seen"].shape != shape
                or found["times"].shape != shape[:1] or len(found["times"]) < 2):
            raise InputError(f"{path}: the observed and simulated tracks do not have the same "
                             "markers and times.", *_DAMAGED)
        return {name: frozen(values) for name, values in found.items()}

    def illustrate(self, section: Section, branch: Branch, key: str) -> None:
        section.title += f" {self.values.get('pull', '')}"
        section.text += self.warnings
        super().illustrate(section, branch, key)


_DAMAGED = "The result of a swing was expected.", Text("The file is damaged. Run ",
                                                       Command("swing"), " again.")


class FitSwing(SwingSettings, KeptStage, BranchStage):
    """Estimate Young's modulus and damping from a free swing, without a robot."""

    about = About(
        "swing", 75, Swing, key="swing", reads=("mesh.vtu", "skeleton.swc", "pulls/"),
        writes=("swing.json", "mesh.vtu"),
        found=("Young's modulus, mean of the branch: {young_pa:Pa} ({young_interval_pa[0]:Pa} to "
               "{young_interval_pa[1]:Pa}); damping ratio {damping_ratio:.3g}.",),
        then="limber energy {branch_folder}", step="estimate", label="Fit a Free Swing")

    def run(self, progress: Progress = SILENT) -> dict[str, Any]:
        """Estimate one level of Young's modulus, and damping, from a released branch.

        The modulus keeps its pattern along the branch. Writes ``swing.json``, and the modulus into
        ``mesh.vtu``.

        Raises:
            InputError: there is no such swing, or nothing swings in it.
            WorkError: the fit does not converge.
        """
        from limber.estimation.forward.forward_model import under_its_weight
        from limber.estimation.vibration.free_swing import SwingSeen, fit_swing
        from limber.recordings.recording import grasp_on
        from limber.store.loading import density_sigma, load_subject, pulls_digest, wood_digest

        branch = Branch.open(self.branch_folder)
        with branch.writing("limber swing"):
            pull = _pull(branch, self.pull)
            subject = load_subject(branch, FitSpec())
            digests = {"mesh geometry": subject.mesh.geometry_digest(),
                       "pulls": pulls_digest(branch, [pull.name])} | wood_digest(branch)
            if self.is_kept(branch, digests=digests):
                return branch.manifest.stages["swing"].result
            about = present(pull.entry.swing, "record of the branch's release")
            seen = present(pull.observations, "observation of the swing")
            rest = np.array(pull.entry.rest_points_m)
            warnings: list[str] = []
            model = under_its_weight(subject.model, pull.entry).with_young(
                subject.mesh.cell_data["young"])
            found = fit_swing(
                model, grasp_on(subject.mesh, pull.entry.grasp),
                SwingSeen(seen.times, seen.positions - rest, rest,
                          about.start, pull.wrenches[0, :3], about.load_mass_kg, about.noise_m,
                          about.registration_m),
                density_sigma=density_sigma(branch),
                progress=progress.keeping(warnings).part(0.0, 0.95))
            if not found.converged:
                raise WorkError("The fit of the swing did not converge.",
                                f"The residual is {100 * found.relative_residual:.0f} % of the "
                                "largest displacement.",
                                "Check load, mass and density.")
            young = found.factor * model.young
            result = _summary(found, young, pull, warnings)
            with branch.stage("swing", self, digests=digests) as stage:
                figure = {"times_s": found.times, "seen_m": found.seen,
                          "simulated_m": found.simulated}
                stage.write("swing.json", result | figure, indent=None)
                subject.mesh.with_data(cell_data={
                    "young": young, "poisson": model.poisson, "density": model.density,
                }).write(stage.path("mesh.vtu"))
                stage.result.update(result)
            return stage.result


def _pull(branch: Branch, name: str | None) -> Pull:
    from limber.recordings.recording import read_entry, read_pull
    from limber.store.loading import known_pulls

    swings = [name for name in known_pulls(branch)
              if read_entry(branch.path(f"pulls/{name}/pull.toml")).motion == "swing"]
    if name is None and len(swings) == 1:
        name = swings[0]
    if name not in swings:
        raise InputError("Which swing is not stated." if swings and name is None else
                         f"{branch.folder} has no swing {name or 'yet'}.",
                         f"It has {', '.join(swings) or 'none'}.", "Name one "
                         "with ", Option("pull"), ", or import one with ",
                         Command("import-pull", Option("motion", "swing"), Option("weight")), ".")
    pull = read_pull(branch.path(f"pulls/{name}"))
    if pull.entry.swing is None or pull.observations is None or pull.entry.rest_points_m is None:
        raise InputError(f"{name}: pull.toml lacks [swing] or rest_points_m, or no markers.",
                         "The release and the markers' rest positions must be known.",
                         "Import it with ", Command("import-pull", Option("motion", "swing")), ".")
    return pull


def _summary(found: SwingFit, young: np.ndarray, pull: Pull, warnings: list[str],
             ) -> dict[str, Any]:
    level = float(young.mean())
    return {
        "pull": pull.name, "young_pa": level,
        "young_interval_pa": (level / found.factor * found.factor_interval).tolist(),
        "young_factor": found.factor, "mesh_factor": found.mesh_factor,
        "release_s": found.release, "release_deviation_s": found.release_deviation,
        "damping_mass_per_s": found.damping[0], "damping_stiffness_s": found.damping[1],
        "damping_mass_interval_per_s": found.damping_interval[0].tolist(),
        "damping_stiffness_interval_s": found.damping_interval[1].tolist(),
        "damping_ratio": found.damping_ratio,
        "damping_ratio_interval": found.damping_ratio_interval.tolist(),
        "frequency_hz": found.frequency, "residual_m": found.residual,
        "relative_residual": found.relative_residual, "independent_readings": found.readings,
        "forward_count": found.forward_count, "window_s": list(found.window),
        "converged": found.converged, "creep": found.creep, "warnings": warnings}
