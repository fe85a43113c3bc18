"""Information of the frames of a pull on the moduli: linearised and summed."""

from dataclasses import dataclass

import numpy as np

from limber.reduced.state import ReducedState


@dataclass(frozen=True)
class OnlineFrame:
    """Measurements at one instant.

    Attributes:
        time: [s].
        pose: Pose of the grasp point [m, rad], shape [6].
        force: Force of the gripper on the branch [N], shape [3]; NaN if not measured.
        positions: Observed points [m], shape [m, 3]; NaN if not observed.
    """

    time: float
    pose: np.ndarray
    force: np.ndarray
    positions: np.ndarray


@dataclass
class Kept:
    """A frame as linearised at ``centre``, log E of shape [K].

    Attributes:
        state: State of the reduced model; None: it belongs to another basis.
        normal, gradient: Normal matrix and gradient of half its squared residuals, shapes [K, K]
        and [K].
        residual: Root mean square of the standardised residuals.
    """

    frame: OnlineFrame
    state: ReducedState | None
    centre: np.ndarray
    normal: np.ndarray
    gradient: np.ndarray
    residual: float


class Information:
    """The information on log E: a prior, kept frames, and merged frames.

    Args:
        centre: Mean of the prior, shape [K].
        deviation: Its standard deviation.
        kept_count: Largest number of frames that are kept for another linearisation.
    """

    def __init__(self, centre: np.ndarray, deviation: float, kept_count: int):
        count = len(centre)
        self._prior = centre.copy(), np.eye(count) / deviation**2
        self._kept_count = kept_count
        self.kept: list[Kept] = []
        self.past: list[OnlineFrame] = []
        self._normal, self._gradient = np.zeros((count, count)), np.zeros(count)

    def add(self, new: Kept) -> None:
        """Keep a frame; if there are too many, the least informative one is merged."""
        self.kept.append(new)
        self.kept.sort(key=lambda kept: kept.frame.time)
        if len(self.kept) <= self._kept_count:
            return
        # The frame whose pose is nearest to its neighbours' adds the least information: it is
        # merged.
        poses = np.array([kept.frame.pose for kept in self.kept])
        steps = np.linalg.norm(np.diff(poses[:, :3], axis=0), axis=1)
        gone = self.kept.pop(int(np.argmin(steps[:-1] + steps[1:])) + 1)
        self.past.append(gone.frame)
        self._normal += gone.normal
        self._gradient += gone.gradient - gone.normal @ gone.centre

    def replace(self, kept: list[Kept]) -> None:
        """Replace all kept and merged frames by these."""
        self.kept, self.past = kept, []
        self._normal[:], self._gradient[:] = 0.0, 0.0

    def normal_gradient(self, log_young: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Normal matrix and gradient of all information, at these moduli: shapes [K, K] and [K]."""
        centre, precision = self._prior
        normal = precision + self._normal
        gradient = precision @ (log_young - centre)
        gradient = gradient + self._gradient + self._normal @ log_young
        for kept in self.kept:
            normal = normal + kept.normal
            gradient = gradient + kept.gradient + kept.normal @ (log_young - kept.centre)
        return normal, gradient
