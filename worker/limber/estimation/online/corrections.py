"""Errors of the reduced model at some frames of a pull, and their interpolation."""

from dataclasses import dataclass

import numpy as np

from limber.estimation.online.full_model import ExactFrame
from limber.estimation.online.information import Kept, OnlineFrame

UNCHECKED_ERROR = 0.3
"""Initial error of the reduced model over the noise of a measurement, before it is measured."""
COVERED = 0.1
"""Fraction of the path between the last frames of the full model."""
STALE = 0.25
"""Change of a log E above which a frame of the full model is solved again at the end."""


@dataclass
class _Correction:
    """Full model minus reduced model at one frame; rows of points, then of the force."""

    frame: OnlineFrame
    centre: np.ndarray
    rows: np.ndarray
    slopes: np.ndarray

    def at(self, log_young: np.ndarray) -> np.ndarray:
        return self.rows + self.slopes @ (log_young - self.centre)


class Corrections:
    """Measured at frames of the full model, interpolated between them.

    Args:
        sigmas: Standard deviations of a frame's measurements, shape [r].
    """

    def __init__(self, sigmas: np.ndarray):
        self._sigmas = sigmas
        self._known: list[_Correction] = []
        self._surprises: list[float] = []

    @property
    def error(self) -> float:
        """Error of the model over the noise of a measurement, from the last full frames."""
        return float(np.sqrt(np.mean(np.square(self._surprises[-3:])))
                     ) if self._surprises else UNCHECKED_ERROR

    @property
    def is_checked(self) -> bool:
        """Whether the error of the reduced model is known."""
        return len(self._surprises) >= 3

    def forget(self) -> None:
        """Discard them, because they belong to another basis."""
        self._known.clear()

    def at(self, frame: OnlineFrame, log_young: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rows [r] and slopes [r, K] to add at a frame: from the two nearest known frames."""
        count = len(self._sigmas)
        if not self._known:
            return np.zeros(count), np.zeros((count, len(log_young)))
        far = np.array([np.linalg.norm(known.frame.pose[:3] - frame.pose[:3])
                        for known in self._known])
        near = np.argsort(far)[:2]
        share = 1 / np.maximum(far[near], 1e-9)
        share /= share.sum()
        chosen = [self._known[index] for index in near]
        return (sum(part * known.at(log_young) for part, known in zip(share, chosen, strict=True)),
                sum(part * known.slopes for part, known in zip(share, chosen, strict=True)))

    def add(self, frame: OnlineFrame, found: ExactFrame, rows: np.ndarray,
            slopes: np.ndarray) -> None:
        """Add a frame of the full model, with the reduced model's rows and slopes for it."""
        exact = np.r_[found.moved.ravel(), found.force]
        d_exact = np.vstack([found.d_moved.reshape(-1, found.d_moved.shape[-1]), found.d_force])
        new = _Correction(frame, found.log_young, exact - rows, d_exact - slopes)
        predicted = self.at(frame, found.log_young)[0]
        self._surprises.append(float(np.sqrt(np.mean(((new.rows - predicted) / self._sigmas)**2))))
        self._known = [old for old in self._known if old.frame is not frame]
        self._known.append(new)

    def next_requested(self, kept: list[Kept], log_young: np.ndarray) -> Kept | None:
        """Return the frame farthest from the known ones. None: none is far."""
        poses = np.array([each.frame.pose[:3] for each in kept])
        far = np.full(len(poses), np.inf)
        for known in self._known:
            near = np.linalg.norm(poses - known.frame.pose[:3], axis=1)
            if np.abs(known.centre - log_young).max() < STALE:
                far = np.minimum(far, near)
        far[[each.state is None for each in kept]] = -1.0
        index = int(np.argmax(far))
        if far[index] < 0 or far[index] < COVERED * np.linalg.norm(np.ptp(poses, axis=0)):
            return None
        return kept[index]
