"""The way a gripper goes in a virtual pull: where the branch goes when it is pulled sideways.

A path invented in space would compress a branch (it buckles) or stretch it (it tears): its length
is fixed and nobody knows beforehand how it bends. A hand feels that and yields. Here the truth is
pulled by a force that grows and turns, and where its grasp then goes is the path.
"""

import numpy as np

from limber.errors import WorkError
from limber.mechanics.grasp import Grasp
from limber.mechanics.model import BranchModel
from limber.mechanics.statics import StaticResult, StaticSettings, solve_static
from limber.progress import SILENT, Progress

SETTINGS = StaticSettings(tolerance=1e-8)


def sideways_forces(axis: np.ndarray, frame_count: int, *, turn: float, phase: float,
                    ) -> np.ndarray:
    """Return forces across ``axis`` that grow from 0 to 1 N and turn on the way, shape [n, 3].

    Args:
        axis: From base to grasp, shape [3].
        frame_count: The first force is 0.
        turn: How far the direction turns about the axis [rad].
        phase: Where it starts [rad].
    """
    axis = axis / np.linalg.norm(axis)
    first = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
    first /= np.linalg.norm(first)
    second = np.cross(axis, first)
    share = np.linspace(0.0, 1.0, frame_count)
    # Speed fades in and out as a robot's does.
    eased = 0.35 * share * share * (3 - 2 * share) + 0.65 * share
    angle = phase + turn * eased
    return eased[:, None] * (np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * second)


def pulled(model: BranchModel, grasp: Grasp, directions: np.ndarray,
           travel: float, *, progress: Progress = SILENT,
           ) -> tuple[list[StaticResult], np.ndarray]:
    """Pull a branch by forces along ``directions`` until its grasp has gone ``travel`` [m].

    The forces' common size is found first, from the unloaded stiffness and then by bisection.

    Returns:
        States, and forces of the gripper on the branch [N], shape [n, 3].

    Raises:
        WorkError: no force moves the grasp as far.
    """
    size = force_for_travel(model, grasp, directions[-1], travel)
    results: list[StaticResult] = []
    start = None
    for index, direction in enumerate(directions):
        progress(index / len(directions), "pulling", frame=index)
        result = solve_static(model, grasp=grasp, grasp_force=size * direction, start=start,
                              settings=SETTINGS).require()
        results.append(result)
        start = result
    return results, size * directions


def force_for_travel(model: BranchModel, grasp: Grasp, direction: np.ndarray, travel: float,
                     ) -> float:
    """Return the factor of ``direction`` [N] that moves the grasp by ``travel`` [m], to 3 %.

    Raises:
        WorkError: none does.
    """
    def moved(size: float, start: StaticResult | None) -> tuple[float, StaticResult]:
        result = solve_static(model, grasp=grasp, grasp_force=size * direction, start=start)
        if not result.converged:
            return np.inf, result
        shift = grasp.weights @ result.displacement[grasp.nodes] - _shift_at_rest(model, grasp)
        return float(np.linalg.norm(shift)), result

    probe = 1e-6
    while (found := moved(probe, None))[0] < 1e-4 * travel and probe < 1e6:
        probe *= 10
    size = probe * min(travel / max(found[0], 1e-12), 50.0)
    low, high = 0.0, np.inf
    result = None
    for _ in range(14):
        distance, tried = moved(size, result)
        if abs(distance - travel) < 0.03 * travel:
            return size
        if distance < travel:
            low, result = size, tried
        else:
            high = size
        if np.isinf(high):
            size *= min(max(travel / distance, 1.2), 3.0)
        elif np.isfinite(distance):
            size = np.clip(size * travel / distance, low + 0.1 * (high - low),
                           high - 0.1 * (high - low))
        else:
            size = (low + high) / 2
    if low > 0:
        return low
    raise WorkError(f"No sideways force moves the grasp by {travel:.3g} m.",
                    "The branch is too short or too stiff there.", "Pull less far (--reach).")


def _shift_at_rest(model: BranchModel, grasp: Grasp) -> np.ndarray:
    if not np.any(model.gravity):
        return np.zeros(3)
    at_rest = solve_static(model).require()
    return grasp.weights @ at_rest.displacement[grasp.nodes]
