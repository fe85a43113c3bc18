"""The torque of a clamping gripper: whether it counts, and its derivatives."""

import numpy as np

from limber.core.errors import InputError
from limber.mechanics.grasp import Grasp
from limber.mechanics.model import BranchModel
from limber.mechanics.sensitivities import ParameterSet, explicit_forces
from limber.recordings.recording import PullEntry
from limber.recordings.synchronisation import Frames


def uses_torque(entry: PullEntry, frames: Frames) -> bool:
    """Whether the gripper's torque counts: for a clamped grasp, and a sensor with a stated torque
    noise. Driven by pose it is an observation; driven by force it acts as a load.
    """
    return (entry.grasp.mode == "rigid" and entry.sensor.torque_sigma_nm is not None
            and bool(np.isfinite(frames.wrenches[:, 3:]).all(axis=1).any()))


def require_torque(name: str, entry: PullEntry, frames: Frames) -> None:
    """Refuse a clamped gripper without torque: its force alone does not determine the motion.

    Raises:
        InputError: its torque was not measured.
    """
    if not uses_torque(entry, frames):
        raise InputError(
            f"{name}: the force of a clamped gripper drives the simulation, but its torque is not "
            "known.",
            "A clamped gripper also bends the branch by a torque. A simulation with the force "
            "alone would not reproduce the pull.",
            "Use --drive pose, or record the torque and give torque_sigma_nm under [sensor] in "
            'pull.toml. If the branch could turn in the gripper, set mode = "point" under '
            "[grasp].")


def torque_slopes(model: BranchModel, grasp: Grasp, parameters: ParameterSet,
                  displacement: np.ndarray, slope: np.ndarray, about: np.ndarray) -> np.ndarray:
    """Return the derivatives of the gripper's torque [N m] about a fixed point, shape [3, p].

    Args:
        model: The branch.
        grasp: The grasp that exerts the torque.
        parameters: The p parameters.
        displacement: Of the nodes [m], shape [n, 3].
        slope: Its derivatives, shape [n, 3, p].
        about: The point [m], shape [3].
    """
    held = grasp.nodes
    arm = model.mesh.nodes[held] + displacement[held] - about
    columns = []
    for column, partial in enumerate(explicit_forces(model, parameters, displacement)):
        out = partial + model.tangent_times(displacement, np.ascontiguousarray(slope[..., column]))
        columns.append(np.cross(arm, out[held]).sum(axis=0))
    return np.array(columns).T
