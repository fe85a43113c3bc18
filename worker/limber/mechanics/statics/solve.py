"""Static equilibrium: mixed-integration-point Newton along a path of small steps.

The path leads from an equilibrium to the target state: prescribed poses move, and the imbalance of
the start under the target loads is released in proportion. Each step starts with a linear solve of
the whole increment (tangent predictor); then Newton, whose geometric stiffness uses the stress that
the last linearisation predicted (Magisano, Leonetti and Garcea 2017), which allows several times
longer steps for a slender branch. A step that fails is halved.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from limber.core.progress import SILENT, Progress
from limber.mechanics.grasp import Grasp
from limber.mechanics.model import BranchModel
from limber.mechanics.statics.equilibrium_path import Path, StaticProblem, Target, why_uncertain
from limber.mechanics.statics.result import DEFAULT_SETTINGS, StaticResult, StaticSettings, Status


def solve_static(model: BranchModel, *, grasp: Grasp | Sequence[Grasp] | None = None,
                 pose: np.ndarray | None = None, grasp_force: np.ndarray | None = None,
                 nodal_forces: np.ndarray | None = None,
                 start: "StaticResult | np.ndarray | None" = None,
                 settings: StaticSettings = DEFAULT_SETTINGS,
                 progress: Progress = SILENT) -> StaticResult:
    """Find the equilibrium of a branch; a failure to converge is a status, not an exception.

    Args:
        grasp: The grasp, or several grasps.
        pose: Pose of the grasp [m, rad], shape [6] ([g, 6] for several). None: the grasp is not
        held at a pose.
        grasp_force: Force [N] of the gripper on the branch instead, spread over the patch,
            shape [3] ([g, 3]).
        nodal_forces: Dead loads [N], shape [node_count, 3], in addition to gravity.
        start: State to start from; default the rest shape.

    Raises:
        InputError: the arguments contradict each other.
    """
    problem = StaticProblem(model, grasp, pose is not None, settings)
    goal = problem.target(pose, grasp_force, nodal_forces)
    begin = problem.displacement_of(start)
    result = _walked(Path(problem, begin, goal, pose), progress)
    if settings.verify and result.converged and start is not None:
        return _verified(problem, result, goal, pose, progress)
    return result


def follow_poses(model: BranchModel, grasp: Grasp | Sequence[Grasp], poses: np.ndarray, *,
                 start: "StaticResult | np.ndarray | None" = None,
                 guess: np.ndarray | None = None, guess_strain: np.ndarray | None = None,
                 settings: StaticSettings = DEFAULT_SETTINGS) -> list[StaticResult]:
    """Find the equilibrium at each of ``poses`` [m, 6] in turn, each from the one before.

    After a pose that fails, the next solve starts from the last converged state.

    Args:
        guess: Possible displacement [m] at the first pose, shape [node_count, 3]. The solve starts
            from it first, and follows the path from ``start`` if no stable equilibrium is near.
        guess_strain: Possible strain there, shape [tet_count, q, 6], if it is known better: the
            strain of a guess between states differs from theirs.
    """
    problem = StaticProblem(model, grasp, True, settings)
    displacement = problem.displacement_of(start)
    results = []
    for number, pose in enumerate(poses):
        goal = problem.target(pose, None, None)
        result = _walked(Path(problem, displacement, goal, pose), SILENT,
                         *((guess, guess_strain) if number == 0 else ()))
        if settings.verify and result.converged:
            result = _verified(problem, result, goal, pose, SILENT)
        if result.converged:
            displacement = result.displacement
        results.append(result)
    return results


def _walked(path: Path, progress: Progress, guess: np.ndarray | None = None,
            strain: np.ndarray | None = None) -> StaticResult:
    """Return the end of a path, with a warning if it is uncertain."""
    result = path.run(progress, guess, strain)
    asked = result.converged and path.settings.way_back
    uncertainty = why_uncertain(path, result) if asked else ""
    if not uncertainty:
        return result
    return replace(result, uncertainty=uncertainty, warnings=[
        *result.warnings, f"{uncertainty[:1].upper()}{uncertainty[1:]}."])


def _verified(problem: StaticProblem, result: StaticResult, goal: Target, pose: np.ndarray | None,
              progress: Progress) -> StaticResult:
    """Return the result, or a refusal if a path from rest in small steps ends at lower energy."""
    careful = replace(problem.settings, max_step=problem.settings.max_step / 4, verify=False)
    other = StaticProblem(problem.model, problem.grasps or None, problem.is_held, careful)
    other.single = problem.single
    again = Path(other, problem.displacement_of(None), goal, pose).run(progress)
    lower = result.energy - again.energy
    if again.converged and lower > 1e-3 * abs(again.energy):
        return replace(
            result, status=Status.false_equilibrium,
            message=f"the energy is {result.energy:.6g} J, but {again.energy:.6g} J on the path "
                    "from rest: a false equilibrium")
    return result
