"""Energy field over grasp poses."""

from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from limber.planning.field import fit_field
from limber.planning.sampling import (
    energy_inputs,
    sample_branch,
    sample_positions,
    without_taut,
)
from limber.progress import SILENT, Progress
from limber.stages.loading import load_grasp_model
from limber.store import Branch


class EnergySettings(BaseModel):
    """How the energy field is sampled."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    samples: int = Field(150, ge=30, description="Grasp positions to solve.")
    deflection: float = Field(0.4, gt=0, le=1.0, description=(
        "Largest distance from rest, as a share of the branch's length up to the grasp."))
    stretch: float = Field(0.2, ge=0, le=1.0, description=(
        "How far out of its curve the branch may be pulled straight: 0 the distance between base "
        "and grasp at rest, 1 the length of branch between them."))
    gravity: bool = Field(False, description=(
        "Let the branch bear its own weight; the scanned shape is then the one it hangs in. "
        "Otherwise it has no weight, and the scanned shape is free of stress."))
    workers: int = Field(2, ge=1, le=16, description="Processes that solve side by side.")
    seed: int = Field(0, ge=0, description="Of the sampled positions.")


def sample_energy_field(folder: Path, settings: EnergySettings, *, force: bool = False,
                        progress: Progress = SILENT) -> dict[str, Any]:
    """Stage ``energy``: sample grasp poses and fit the field; writes ``energy.npz``.

    Raises:
        BranchFolderError: no mesh yet.
        WorkError: too few poses could be solved.
    """
    branch = Branch.open(folder)
    grasp_model = load_grasp_model(branch, gravity=settings.gravity)
    digests = energy_inputs(grasp_model)
    if not force and branch.is_current("energy", settings, digests=digests):
        return branch.manifest.stages["energy"].result
    with branch.stage("energy", settings, digests=digests) as stage:
        progress(0.0, "rest state")
        targets = sample_positions(
            grasp_model.reach, grasp_model.rest_position, settings.samples,
            deflection=settings.deflection, stretch=settings.stretch, seed=settings.seed)
        samples, reasons = sample_branch(grasp_model, targets, workers=settings.workers,
                                         progress=progress.part(0.02, 0.9))
        samples, taut_count = without_taut(samples)
        field = fit_field(samples, grasp_model.reach.base, seed=settings.seed,
                          progress=progress.part(0.9, 1.0))
        rejected = len(samples.rejected_poses)
        if rejected > 0.2 * settings.samples:
            progress.warn(f"{rejected} of {settings.samples} poses were rejected ({reasons}); "
                          "paths keep away from them.")
        field.write(stage.path("energy.npz"), {
            "rest_pose": samples.poses[0], "arc_length_m": np.array(grasp_model.reach.arc_length)})
        stage.result.update(
            sample_count=len(samples.poses), rejected_count=rejected, rejected_reasons=reasons,
            taut_count=taut_count,
            energy_error=field.errors["energy_error"], force_error=field.errors["force_error"],
            errors=field.errors, kernel=field.work_fit.kernel, shape=field.work_fit.shape,
            chart_stretch=field.chart.stretch,
            fitted_to_forces=len(field.work_fit.gradient_weights) > 0,
            max_energy_j=float(samples.energies.max()),
            max_force_n=float(np.linalg.norm(samples.forces, axis=1).max()),
            rest_position_m=samples.poses[0, :3], arc_length_m=grasp_model.reach.arc_length)
    progress(1.0, "energy field fitted")
    return branch.manifest.stages["energy"].result
