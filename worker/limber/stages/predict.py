"""Where a branch rests under another load, with its estimated modulus."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from limber.errors import InputError
from limber.estimation.predict import PredictSettings, predict_rest, require_one_load
from limber.estimation.settings import EstimateSettings
from limber.plain import plain
from limber.progress import SILENT, Progress
from limber.recordings.recording import PullEntry, read_entry
from limber.stages.loading import known_pulls, load_subject
from limber.store import Branch


def predict(branch_folder: Path, settings: PredictSettings, *, progress: Progress = SILENT,
            ) -> dict[str, Any]:
    """Simulate the branch at rest under another load than the recorded one; writes nothing.

    Returns:
        See :func:`limber.estimation.predict.predict_rest`.

    Raises:
        InputError: no load, nothing estimated yet, or no such pull.
        WorkError: the branch finds no equilibrium under the load.
    """
    require_one_load(settings)
    branch = Branch.open(branch_folder)
    known = json.loads(branch.require("estimate.json", "estimate").read_text(encoding="utf-8"))
    entry = _entry(branch, settings.pull)
    subject = load_subject(branch, EstimateSettings(fractions=tuple(known["fractions"])))
    down = np.array(branch.gravity) / np.linalg.norm(branch.gravity)
    return plain(predict_rest(known, subject, entry, down, settings, progress))


def _entry(branch: Branch, name: str | None) -> PullEntry:
    names = known_pulls(branch)
    if not names or (name is not None and name not in names):
        raise InputError(f"{branch.folder} has no pull {name or ''}.",
                         f"It has {', '.join(names)}." if names else "It has none.",
                         "Bring one in with `limber import-pull`.")
    return read_entry(branch.path(f"pulls/{name or names[0]}/pull.toml"))
