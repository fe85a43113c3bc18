"""Reference frames in a bag: the pose of one in another, from its transforms."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from limber.recordings.bags.bag_reader import Topic

_MOST_LINKS = 32


@dataclass(frozen=True)
class Motion:
    """A frame in another over time, or a static one.

    Attributes:
        times: [s], increasing, shape [n].
        positions: [m], shape [n, 3].
        turns: Shape [n].
    """

    times: np.ndarray
    positions: np.ndarray
    turns: Rotation

    @classmethod
    def of(cls, times: np.ndarray, values: np.ndarray) -> "Motion":
        """Return it from rows of position and quaternion (x, y, z, w), [n, 7]."""
        good = (np.isfinite(values).all(axis=1) & np.isfinite(times)
                & (np.linalg.norm(np.nan_to_num(values[:, 3:]), axis=1) > 1e-6))
        times, first = np.unique(times[good], return_index=True)
        values = values[good][first]
        return cls(times, values[:, :3], Rotation.from_quat(values[:, 3:]))

    def at(self, times: np.ndarray) -> tuple[np.ndarray, Rotation]:
        """Return position [n, 3] and rotation at ``times``; outside their range the nearest known.
        """
        if len(self.times) == 1:
            return np.repeat(self.positions, len(times), axis=0), self.turns[[0] * len(times)]
        inside = np.clip(times, self.times[0], self.times[-1])
        position = np.column_stack([np.interp(inside, self.times, column)
                                    for column in self.positions.T])
        return position, Slerp(self.times, self.turns)(inside)


class Frames:
    """All frames that a bag's transforms connect."""

    def __init__(self, topics: tuple[Topic, ...], clock: str):
        self._links: dict[str, dict[str, tuple[Motion, bool]]] = {}
        for topic in topics:
            # A static transform is often sent only once, at any time: its stamp does not count.
            motion = Motion.of(getattr(topic, clock), topic.values)
            parent, child = topic.frame.lstrip("/"), topic.labels[0].lstrip("/")
            if len(motion.times) and parent != child:
                self._links.setdefault(parent, {})[child] = (motion, False)
                self._links.setdefault(child, {})[parent] = (motion, True)

    @property
    def names(self) -> list[str]:
        """Every frame."""
        return sorted(self._links)

    def between(self, frame: str, within: str, times: np.ndarray,
                ) -> tuple[np.ndarray, Rotation] | None:
        """Return position [n, 3] and rotation of ``frame`` in ``within``; None if unknown."""
        chain = self._transform_chain(within.lstrip("/"), frame.lstrip("/"))
        if chain is None:
            return None
        position, turn = np.zeros((len(times), 3)), Rotation.identity(len(times))
        for motion, is_inverse in chain:
            step, turned = motion.at(times)
            if is_inverse:
                turned = turned.inv()
                step = -turned.apply(step)
            position, turn = position + turn.apply(step), turn * turned
        return position, turn

    def _transform_chain(self, start: str, end: str) -> list[tuple[Motion, bool]] | None:
        if start == end:
            return []
        reached: dict[str, list[tuple[Motion, bool]]] = {start: []}
        for _ in range(_MOST_LINKS):
            grown = {other: [*chain, link] for name, chain in reached.items()
                     for other, link in self._links.get(name, {}).items() if other not in reached}
            if not grown:
                return None
            reached |= grown
            if end in reached:
                return reached[end]
        return None
