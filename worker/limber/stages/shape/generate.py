"""Stage ``generate``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from pydantic import Field

from limber.core.errors import InputError
from limber.core.files.atomic import file_digest, write_atomically
from limber.core.json_values import plain
from limber.core.progress import SILENT, Progress
from limber.core.settings import Groups
from limber.geometry.settings import BranchSpec, GeneratedSettings
from limber.stages.result import Numbers, Result, kept, shown
from limber.stages.stage import About, Stage, argument

if TYPE_CHECKING:
    from limber.geometry.generated import GeneratedBranch


class Generated(Result):
    """A branch with known truth, and its scan.

    >>> limber.generate("made", length=0.3, fork_count=0, seed=1).young.shape
    (4,)
    """

    point_count: int = shown("points", ",")
    length: float = shown("length", ".3f m")
    branch_count: int = shown("branches")
    cloud: Path = shown("scan", meaning="the scan, for :func:`limber.reconstruct`")
    young: Numbers = kept("true Young's modulus at the control points [Pa], shape [K]")


class Generate(GeneratedSettings, Stage):
    """Generate a branch with known truth, and scan it as a scanner would."""

    about = About(
        "generate", 10, Generated,
        found=("A branch with known truth: {length_m:m} in {branch_count:#branch/branches}, "
               "scanned as {point_count:count} points.",),
        then="limber reconstruct {cloud} -o {folder}.branch")
    groups: ClassVar[Groups] = {"shape": ("seed",)}
    common = ("seed", "length", "fork_count", "view")

    folder: Path = argument("The folder to make.", group="output")
    seed: int = Field(0, description="Seed of everything random.")

    def run(self, progress: Progress = SILENT) -> dict[str, Any]:
        """Make a branch with known truth and write its scan and the truth into the folder.

        Raises:
            InputError: the folder cannot be written to.
        """
        from limber.geometry.generated import generate_branch

        progress(0.1, "generating")
        return write_generated(generate_branch(self.seed, **BranchSpec.of(self).model_dump()),
                               self.folder)


def write_generated(branch: GeneratedBranch, folder: Path) -> dict[str, Any]:
    """Write the scan and the truth, ``cloud.ply``, ``truth_skeleton.swc``, ``truth_surface.ply``
    and ``truth.json``; return what was written. InputError if the folder cannot be written to."""
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        branch.cloud.write_ply(folder / "cloud.ply")
        branch.skeleton.write_swc(folder / "truth_skeleton.swc")
        branch.surface.write_ply(folder / "truth_surface.ply")
        write_atomically(folder / "truth.json", json.dumps(plain({
            "seed": branch.seed, "spec": branch.spec, "young_pa": branch.young,
            "control_points_m": branch.control_points, "fractions": branch.fractions,
            "cloud_sha256": file_digest(folder / "cloud.ply")}), indent=1) + "\n")
    except OSError as error:
        raise InputError(f"{folder} cannot be written to ({error.strerror}).",
                         "The scan and its truth go there.", "Choose another folder.") from error
    return {"cloud": str(folder / "cloud.ply"), "point_count": len(branch.cloud),
            "branch_count": branch.skeleton.branch_count, "length_m": branch.skeleton.length,
            "young_pa": branch.young, "surface_volume_m3": branch.surface.volume}
