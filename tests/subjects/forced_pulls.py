"""Pulls of the small branch that state no cell, and the objective that tests of forces fit."""

from dataclasses import replace

import numpy as np

from benchmarks.paper_branches import measured
from limber.estimation.settings import FitSpec
from limber.recordings.recording import Pull

SETTINGS = FitSpec(poisson=0.36, hold_out=False, key_frames=4)
TRUTH = np.array([40e6, 22e6, 12e6, 3e6])


def without_cell(pull: Pull) -> Pull:
    """The pull as measured, without a cell: its path is observed, not prescribed."""
    entry = pull.entry.model_copy(update={"calibration": None})
    return replace(measured(pull, 3), entry=entry)


def with_force(pull: Pull, change) -> Pull:
    """The same pull with other readings of the force; ``change`` maps [n, 3]."""
    wrenches = pull.wrenches.copy()
    wrenches[:, :3] = change(wrenches[:, :3])
    return replace(pull, wrenches=wrenches)


def by_differences(values, free: np.ndarray, step: float) -> np.ndarray:
    """Slopes [r, p] of values [r] of a free vector [p] by central differences."""
    return np.column_stack([(values(free + each) - values(free - each)) / (2 * step)
                            for each in step * np.eye(len(free))])


def residual_slopes(objective, free: np.ndarray, step: float) -> np.ndarray:
    """Slopes [r, p] of an objective's residuals by central differences."""
    return by_differences(lambda each: objective.evaluate(each).residual, free, step)
