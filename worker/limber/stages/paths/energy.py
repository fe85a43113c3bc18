"""Stage ``energy``."""

from typing import Any, ClassVar

import numpy as np

from limber.core.errors import Option
from limber.core.progress import SILENT, Progress
from limber.planning.settings import EnergySettings, EnergySpec
from limber.stages.result import FORCE, Picture, Result, frozen, of_files, shown
from limber.stages.stage import About, BranchStage, Repeatable
from limber.store import Branch

_MOST_TIMES = 4  # multiple of the requested samples that --field-error may take


class EnergyField(Result):
    """Deformation energy over the position of the grasp.

    >>> field = limber.open("a.branch").results["energy"]
    >>> field.energy(field.positions[:2]).shape, bool(field.energy_error < 0.1)
    ((2,), True)
    """

    heading = "Energy over grasp poses"
    missing = "limber energy NAME.branch"
    pictures = (Picture("figures.energy_samples", "Strain energy of the sampled grasp poses "
                        "against the distance from rest, and the force.",
                        ("positions", "energies", "forces")),)
    columns: ClassVar = {"positions": "x_m y_m z_m", "energies": "energy_j", "forces": FORCE}

    sample_count: int = shown("samples", ",")
    rejected_count: int = shown("rejected", ",")
    max_energy: float = shown("largest energy", ".4g J")
    max_force: float = shown("largest force", ".4g N")
    energy_error: float = shown("error of the energy", ".2g %", meaning=(
        "root mean square error over that of the energy, for samples outside the fit"))
    force_error: float = shown("error of the force", ".2g %", meaning="likewise of the force")
    positions: np.ndarray = of_files("sampled positions of the grasp [m], shape [m, 3]; the first "
                                     "is at rest")
    energies: np.ndarray = of_files("potential of strain and weight above the rest shape there "
                                    "[J], shape [m]")
    forces: np.ndarray = of_files("forces of the gripper on the branch there [N], shape [m, 3]")
    field: Any = of_files("the fit, an :class:`limber.planning.field.energy_field.EnergyField`")

    def of_folder(self, branch: Branch, key: str) -> dict[str, Any]:
        from limber.planning.field import energy_field

        field = energy_field.EnergyField.read(branch.path("energy.npz"))
        return {"field": field, **{name: frozen(getattr(field.samples, name))
                                   for name in ("positions", "energies", "forces")}}

    def energy(self, points: np.ndarray) -> np.ndarray:
        """Return the energy [J] with the grasp at ``points`` [m], shape [n, 3]; shape [n]."""
        return self.field.energy(np.asarray(points, float))

    def force(self, points: np.ndarray) -> np.ndarray:
        """Return the gripper's force [N] with the grasp at ``points`` [m], both [n, 3]."""
        return self.field.force(np.asarray(points, float))


class SampleEnergy(EnergySettings, Repeatable, BranchStage):
    """Sample the deformation energy over grasp poses, and fit a field to it."""

    about = About(
        "energy", 90, EnergyField, key="energy", reads=("mesh.vtu", "skeleton.swc"),
        writes=("energy.npz",),
        found=("{sample_count} poses solved, {rejected_count} rejected.",
               "Error of the field: energy {energy_error:share}, force {force_error:share}."),
        then="limber plan {branch_folder}", step="plan", label="Sample the Energy")

    def run(self, progress: Progress = SILENT) -> dict[str, Any]:
        """Sample grasp poses and fit the field; writes ``energy.npz``.

        Raises:
            BranchFolderError: there is no mesh yet.
            WorkError: too few poses could be solved.
        """
        from limber.planning.field.energy_field import fit_field
        from limber.planning.field.other_modulus import corrected_field, material_of
        from limber.planning.field.sampling import energy_inputs, sample_field
        from limber.store.loading import load_grasp_model

        branch = Branch.open(self.branch_folder)
        grasp_model = load_grasp_model(branch, gravity=EnergySpec.of(self).gravity,
                                       progress=progress)
        digests = energy_inputs(grasp_model)
        if self.is_kept(branch, digests=digests):
            return branch.manifest.stages["energy"].result
        earlier = branch.manifest.stages.get("energy")
        with branch.stage("energy", self, digests=digests) as stage:
            field, told, count = None, dict[str, Any](), self.samples
            if earlier and self.is_kept(branch, digests=digests | {
                    "material": earlier.reads.get("material", "")}):
                field = corrected_field(branch.path("energy.npz"), grasp_model, progress)
            asked = 0.01 * (self.field_error or np.inf)
            while field is None or (field.errors["energy_error"] > asked
                                    and count <= _MOST_TIMES * self.samples):
                sampled = sample_field(grasp_model, self.model_copy(update={"samples": count}),
                                       progress=progress.part(0.0, 0.8))
                field = fit_field(sampled.samples, sampled.energy_surface.pivot,
                                  sampled.energy_surface.radius, progress=progress.part(0.8, 1.0))
                told = {"rejected_reasons": sampled.reasons, "taut_count": sampled.taut_count}
                count *= 2
            if field.errors["energy_error"] > asked:
                progress.warn(
                    f"The error of the energy field is {100 * field.errors['energy_error']:.2g} % "
                    f"with {len(field.samples.poses)} poses, more than the {100 * asked:g} % of ",
                    Option("field_error"), ". Increase ", Option("samples"), ", or reduce ",
                    Option("deflection"), ".")
            samples, rejected = field.samples, len(field.samples.rejected_poses)
            if rejected > 0.2 * self.samples:
                why = [f"{n} {text}" for text, n in told.get("rejected_reasons", {}).items()]
                progress.warn(f"{rejected} of {self.samples} poses were rejected "
                              f"({', '.join(why)}). Paths avoid them.")
            field.write(stage.path("energy.npz"), {
                "target_names": np.array([t.name for t in grasp_model.branch.targets], "U64"),
                "rest_pose": samples.poses[0], "chart_base_m": grasp_model.reach.base,
                "arc_length_m": np.array(grasp_model.reach.arc_length),
                "material": material_of(grasp_model)})
            stage.result.update(
                sample_count=len(samples.poses), rejected_count=rejected, **told,
                energy_error=field.errors["energy_error"], force_error=field.errors["force_error"],
                errors=field.errors, kernel=field.energy_fit.kernel, shape=field.energy_fit.shape,
                chart_stretch=field.chart.stretch,
                chart_depth_m=field.chart.depth if np.isfinite(field.chart.depth) else None,
                max_energy_j=float(samples.energies.max()),
                max_force_n=float(np.linalg.norm(samples.forces, axis=1).max()),
                rest_position_m=samples.poses[0, :3], arc_length_m=grasp_model.reach.arc_length)
        progress(1.0, "energy field fitted")
        return branch.manifest.stages["energy"].result
