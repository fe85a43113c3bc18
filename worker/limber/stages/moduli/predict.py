"""Stage ``predict``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from limber.core.errors import Command, InputError
from limber.core.json_values import plain
from limber.core.progress import SILENT, Progress
from limber.estimation.settings import PredictSettings
from limber.stages.result import Interval, Numbers, Result, Vector, kept, shown
from limber.stages.stage import About, BranchStage
from limber.store import Branch

if TYPE_CHECKING:
    from limber.recordings.recording import PullEntry


class Prediction(Result):
    """Where the points come to rest under another load."""

    drop: float = shown("the points sink by", ".3g mm")
    drop_interval: Interval = kept("its 95 % interval [m]")
    drops: Numbers = kept("of each point, downwards [m]")
    load: Vector = kept("the load [N]")
    young: Numbers = kept("Young's modulus at the control points [Pa], shape [K]")


class Predict(PredictSettings, BranchStage):
    """Predict where the branch comes to rest under another load."""

    about = About(
        "predict", 77, Prediction, reads=("mesh.vtu", "skeleton.swc", "estimate.json", "pulls/"),
        found=("Under the load the points sink by {drop_m:m} ({drop_interval_m[0]:m} to "
               "{drop_interval_m[1]:m}, 95 % interval).",),
        step="estimate", label="Predict Another Load")

    def run(self, progress: Progress = SILENT) -> dict[str, Any]:
        """Simulate the branch at rest under another load than the recorded one; writes no file.

        Returns:
            See :func:`limber.estimation.prediction.predict_rest`.

        Raises:
            InputError: there is no load, no estimate yet, or no such pull.
            WorkError: no equilibrium of the branch was found under the load.
        """
        from limber.estimation.estimate_file import read_estimate
        from limber.estimation.prediction import predict_rest, require_one_load
        from limber.store.loading import load_estimated_subject

        require_one_load(self)
        branch = Branch.read(self.branch_folder)
        known = read_estimate(branch.require("estimate.json", "estimate"))
        entry = _entry(branch, self.pull)
        subject = load_estimated_subject(branch, known, gravity=True)
        down = np.array(branch.gravity) / np.linalg.norm(branch.gravity)
        return plain(predict_rest(known, subject, entry, down, self, progress))


def _entry(branch: Branch, name: str | None) -> PullEntry:
    from limber.recordings.recording import read_entry
    from limber.store.loading import known_pulls

    names = known_pulls(branch)
    if not names or (name is not None and name not in names):
        raise InputError(f"{branch.folder} has no pull {name or 'yet'}.",
                         f"It has {', '.join(names)}." if names else "It has none.",
                         "Import one with ", Command("import-pull"), ".")
    return read_entry(branch.path(f"pulls/{name or names[0]}/pull.toml"))
