"""Moduli of the other likely skeletons of a scan: what the choice of one of them may be wrong by.

Alternatives that differ only by twigs that may not exist are among the posterior samples of the
shape. Another attachment, another root, or a branch that is missing changes what is pulled: the
pulls are fitted on each of them again, and their likelihood counts beside the scan's probability.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from limber.core.errors import Cancelled, Command, LimberError, Text
from limber.core.json_values import validated
from limber.core.progress import SILENT, Progress
from limber.estimation.settings import FitSpec
from limber.store import Branch

if TYPE_CHECKING:
    from limber.estimation.fit_assessment import Estimate
    from limber.geometry.skeleton.edits import Edit
    from limber.recordings.recording import Pull

LEAST = 0.05
"""Probability over that of the skeleton in use below which an alternative does not matter."""
MOST = 2
"""Most alternatives that are fitted."""


@dataclass(frozen=True)
class _Graph:
    """An alternative, numbered as in ``limber skeleton``, its probability over that of the skeleton
    in use, and the edits that make it of that, in the scan's coordinates."""

    number: int
    odds: float
    edits: list[Edit]


def add_other_skeletons(found: Estimate, branch: Branch, pulls: Sequence[Pull],
                        settings: FitSpec, progress: Progress = SILENT) -> None:
    """Add the differences of other likely skeletons' moduli to the errors of the model, by the
    estimate on the skeleton in use and pulls with the rest positions of their observed points."""
    changes, weights = [], [1.0]
    for graph in _graphs(branch):
        named = Text(f"The skeleton may be another one: alternative {graph.number} of ",
                     Command("skeleton"), f" has {graph.odds:.2g} times the probability of the one "
                     "in use.")
        try:
            other = _fitted(graph, found, branch, pulls, settings, progress)
        except Cancelled:
            raise
        except LimberError as error:
            progress.warn(f"{named} There is no estimate for it ({error.seen}), and the intervals "
                          "do not include it.")
            continue
        change = np.log(other.values.young / found.values.young)
        ratio = found.fit.evaluation.objective - other.fit.evaluation.objective
        weight = graph.odds * float(np.exp(np.clip(ratio, -50.0, 50.0)))
        changes.append(change)
        weights.append(weight)
        values = ", ".join(f"{value / 1e6:.3g}"
                           for value in other.values.young * found.model_error.mesh_factor)
        progress.warn(f"{named} With the pulls it is {weight:.2g} times as likely, and gives "
                      f"{values} MPa. The intervals include the difference.")
    if changes:
        share = np.array(weights) / np.sum(weights)
        found.model_error = found.model_error.having(
            graph=np.sqrt(share[1:] @ np.square(changes)))


def _graphs(branch: Branch) -> list[_Graph]:
    """The alternatives that matter, most likely first."""
    from limber.geometry.skeleton.edits import DeleteBranch, Edit

    known = branch.made.result.get("alternatives", []) if branch.made else []
    if len(known) < 2:
        return []
    graphs = [_Graph(number, each["probability"] / known[0]["probability"],
                     validated(list[Edit], each["edits"]))
              for number, each in enumerate(known[1:], start=2)]
    return [graph for graph in graphs if graph.odds > LEAST and not all(
        isinstance(edit, DeleteBranch) for edit in graph.edits)][:MOST]


def _fitted(graph: _Graph, found: Estimate, branch: Branch, pulls: Sequence[Pull],
            settings: FitSpec, progress: Progress) -> Estimate:
    """The same pulls on another skeleton."""
    from limber.estimation.estimated_branch import lumped, subject_of
    from limber.estimation.fit import fit_branch
    from limber.estimation.fit_assessment import require_result
    from limber.estimation.fitting.objective import EvaluationLog
    from limber.geometry.reconstruction import mesh_skeleton
    from limber.geometry.settings import ReconstructSettings
    from limber.geometry.skeleton.edits import edited
    from limber.store.loading import hung_masses, load_masses, load_skeleton, load_targets

    progress(0.0, f"fitting alternative {graph.number} of the skeleton")
    skeleton = edited(load_skeleton(branch), [
        edit.aligned(branch.manifest.alignment) for edit in graph.edits])
    meshed = mesh_skeleton(skeleton, ReconstructSettings.model_validate(
        branch.manifest.stages["reconstruct"].settings), branch.gravity)
    leaves = [mass for mass in load_masses(branch) if mass.get("kind") == "leaf"]
    subject = subject_of(meshed.mesh, skeleton, hung_masses(
        [*meshed.masses, *leaves], load_targets(branch)), branch.gravity, settings)
    if found.is_weightless:
        subject = subject.without_weight()
    other = fit_branch(list(pulls), lumped(subject, list(pulls), settings), settings, quick=True,
                       log=EvaluationLog(None, ""), near=found.values,
                       progress=progress.keeping([], silently=True))
    require_result(other, skeleton)
    return other
