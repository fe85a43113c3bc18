"""Whether a branch that snapped would return: the same path, followed backwards.

A straight part that buckles straightens again. A bow that turned over stays so: start and end are
two stable states of one grasp, and the history of the branch decides which one is real.
"""

import numpy as np

from limber.core.progress import SILENT
from limber.mechanics.statics.equilibrium_path import Path
from limber.mechanics.statics.result import StaticResult
from limber.mechanics.statics.static_problem import Target

_SAME = 1e-3
"""Distance, as a fraction of the branch's extent, below which the start counts as reached."""


def why_uncertain(path: Path, result: StaticResult) -> str:
    """Return why a converged result may not be the only state of its grasp, or an empty string.

    Free unless the branch snapped; then it costs as much as the path itself.
    """
    if not path.snaps:
        return ""
    where = f"the branch snapped through at {100 * path.snaps[0][0]:.0f} % of the path"
    begin, grasps = path.begin, path.problem.grasps
    pose = None if path.pose is None else np.array(
        [grasp.pose_of(path.model.mesh.nodes, begin) for grasp in grasps])
    goal = Target(np.where(path.equations.held[:, None], begin, 0.0), path.begin_pins,
                  path.goal.load - path.imbalance)
    back = Path(path.problem, result.displacement, goal, pose).run(SILENT)
    if not back.converged:
        return f"{where}, and no return path was found ({back.message})"
    away = float(np.linalg.norm(back.displacement - begin, axis=1).max())
    if away <= _SAME * path.model.extent:
        return ""
    return (f"{where}, and on the return path it ends {1e3 * away:.0f} mm from its start: another "
            "stable state exists for the same grasp")
