"""The initial branch of a session, and the inputs of its reduced model."""

from pathlib import Path

from limber.core.progress import SILENT, Progress
from limber.reduced.reduced_model import ReducedSettings
from limber.reduced.training import TrainingSettings
from limber.session.session_branch import HeldBranch
from limber.session.settings import SessionSettings
from limber.store import Branch
from limber.store.loading import load_branch, load_skeleton, stiffness_deviation


def reduced_settings(settings: SessionSettings) -> ReducedSettings:
    """Return the data from which the reduced model is made."""
    training = TrainingSettings(grasp_count=settings.grasps, young_spread=settings.young_spread)
    return ReducedSettings(size=settings.size, field_count=settings.fields, training=training,
                           vibration_count=1 if settings.young_spread == 1 else 0)


def load_held(folder: Path, settings: SessionSettings,
              progress: Progress = SILENT) -> HeldBranch:
    """Return the branch of a folder as it hangs, without grasps.

    Raises:
        BranchFolderError: no branch folder, or no mesh in it. InputError: it lacks the material.
    """
    branch = Branch.read(folder)
    axes = load_skeleton(branch) if branch.has("skeleton.swc") else None
    return HeldBranch(load_branch(branch, gravity=settings.gravity, progress=progress), axes,
                      stiffness_deviation(branch))
