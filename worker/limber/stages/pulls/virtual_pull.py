"""Stage ``virtual-pull``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from limber.core.progress import SILENT, Progress
from limber.estimation.settings import PullSpec, VirtualPullSettings
from limber.stages.pulls.import_pull import Pull
from limber.stages.stage import About, BranchStage, KeptStage, given
from limber.store import Branch

if TYPE_CHECKING:
    from limber.estimation.simulated_pull import TrueBranch


def _assumed_line(result: Mapping[str, Any]) -> str | None:
    base, *_, tip = result["young_true_pa"]
    return (f"Its modulus is assumed, {base / 1e9:.3g} to {tip / 1e9:.3g} GPa: it says nothing "
            "of the real branch." if result["young_assumed"] else None)


class VirtualPull(VirtualPullSettings, KeptStage, BranchStage):
    """Simulate a recorded pull with a known Young's modulus and sensor noise."""

    about = About(
        "virtual-pull", 52, Pull, key="pull:{name}", reads=("skeleton.swc",),
        writes=("pulls/{name}/",),
        found=("Simulated pull {pull}: {travel_m:m} of travel, peak force {peak_force_n:N}, "
               "{frame_count} frames.", _assumed_line),
        then="limber estimate {branch_folder}", step="pulls", label="Simulate a Pull")

    name: str = given("Name of the pull.", "pull-1", group="output", common=True)

    def run(self, progress: Progress = SILENT) -> dict[str, Any]:
        """Simulate a pull of a branch and write it as ``pulls/NAME``.

        Returns:
            ``pull``, ``young_true_pa``, ``young_assumed``, ``control_points_m``, ``frame_count``,
            ``tet_count`` of the truth's mesh, ``peak_force_n``, ``travel_m``.

        Raises:
            InputError: the branch has no skeleton, or the settings do not fit it.
            WorkError: the branch cannot be pulled in this way.
        """
        from limber.estimation.simulated_pull import simulate_pull, write_depth_frames
        from limber.recordings.recording import write_pull

        branch = Branch.open(self.branch_folder)
        branch.require("skeleton.swc", "reconstruct")
        key, name = self.entry, self.name
        body = ("mesh.vtu",) if _is_meshed_body(branch) else ()
        reads = [file for file in ("skeleton.swc", "cloud.ply", "truth/skeleton.swc",
                                   "truth/truth.json", *body) if branch.has(file)]
        digests = ({} if self.cell_errors in ("none", "realistic") else
                   {"cell errors": self.calibration.model_dump_json()})
        if self.is_kept(branch, reads=reads, digests=digests):
            return branch.manifest.stages[key].result
        spec = PullSpec.of(self)
        if not isinstance(self, PullSpec) and branch.made is not None:
            # The true branch is of the wood that the branch was made with.
            made = branch.made.settings
            spec = spec.model_copy(update={name: value for name, value in made.items()
                                           if name in ("poisson", "density")})
        progress(0.02, "meshing the true branch")
        truth = load_truth(branch, spec)
        with branch.stage(key, self, reads=reads, digests=digests) as stage:
            prefix = f"pulls/{name}/"
            for old in [file for file in branch.manifest.files if file.startswith(prefix)]:
                stage.remove(old)
            folder = stage.path(prefix + "pull.toml").parent
            pull, displacements = simulate_pull(truth, name, spec, progress=progress.part(0.1, 0.9))
            write_pull(folder, pull)
            if self.camera:
                write_depth_frames(folder, truth, pull, displacements, spec)
            reaction = np.linalg.norm(pull.wrenches[:, :3], axis=1)
            stage.result.update({
                "pull": name, "young_true_pa": truth.young,
                "control_points_m": truth.control_points, "young_assumed": truth.is_assumed,
                "fractions": truth.fractions, "frame_count": len(pull.times),
                "tet_count": truth.mesh.tet_count, "peak_force_n": reaction.max(),
                "travel_m": np.linalg.norm(pull.poses[:, :3] - pull.poses[0, :3], axis=1).max()})
        return stage.result


def load_truth(branch: Branch, settings: PullSpec) -> TrueBranch:
    """The truth of a branch folder: its generator's, the meshed body, or one that fits its scan."""
    from limber.estimation.simulated_pull import true_branch
    from limber.geometry.generated import read_truth
    from limber.geometry.io.skeletons import read_swc
    from limber.store.loading import load_mesh

    known: dict[str, Any] = {"source": branch.manifest.source.get("sha256", "")}
    where = "skeleton.swc"
    if branch.has("truth/truth.json"):
        truth = read_truth(branch.path("truth/truth.json"))
        known |= {"fractions": tuple(truth["fractions"]), "young": truth["young_pa"]}
        where = "truth/skeleton.swc"
    body = load_mesh(branch) if _is_meshed_body(branch) else None
    found = true_branch(read_swc(branch.path(where)), settings, gravity=branch.gravity,
                        body=body, scan=_scan(branch, settings), **known)
    return replace(found, is_assumed="young" not in known)


def _scan(branch: Branch, settings: PullSpec) -> np.ndarray | None:
    """The points that determine a drawn shape; None if the truth is known, or there is no scan."""
    from limber.geometry.io.clouds import read_cloud

    known = branch.has("truth/truth.json") or not branch.has("cloud.ply")
    return None if known or settings.shape == "fitted" else read_cloud(
        branch.path("cloud.ply")).points


def _is_meshed_body(branch: Branch) -> bool:
    """Whether `limber mesh` made the branch: its own tetrahedra are then the truth."""
    return "mesh" in branch.manifest.stages and branch.has("mesh.vtu") and not branch.has(
        "truth/truth.json")
