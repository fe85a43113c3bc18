"""Statics of a body with a moved boundary: patch tests and manufactured solutions."""

from dataclasses import replace

import numpy as np

from limber.core.progress import SILENT
from limber.mechanics.model import BranchModel
from limber.mechanics.statics.equilibrium_path import Path, StaticProblem
from limber.mechanics.statics.solve import DEFAULT_SETTINGS, StaticResult, StaticSettings


def solve_prescribed(model: BranchModel, displacement: np.ndarray, *,
                     nodal_forces: np.ndarray | None = None,
                     settings: StaticSettings = DEFAULT_SETTINGS) -> StaticResult:
    """Find the equilibrium with the model's fixed nodes moved by ``displacement``.

    Args:
        displacement: [m], shape [node_count, 3]; rows of nodes that are not fixed are unused.
    """
    problem = StaticProblem(model, None, False, settings)
    goal = problem.target(None, None, nodal_forces)
    held = np.where(model.fixed[:, None], displacement, 0.0)
    return Path(problem, np.zeros_like(held), replace(goal, held=held), None).run(SILENT)
