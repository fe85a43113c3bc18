"""Arrays that the solver of a reduced model reuses, and the equilibria that it finds."""

from dataclasses import dataclass

import numpy as np

from limber.reduced.state import ReducedStaticSettings


@dataclass
class Workspace:
    """Arrays that the kernel writes to."""

    strain: np.ndarray
    jacobian: np.ndarray
    gradient: np.ndarray
    tangent: np.ndarray

    @classmethod
    def of(cls, linear: np.ndarray) -> "Workspace":
        count, size = linear.shape
        return cls(np.empty(count), np.empty((count, size)), np.empty(size),
                   np.empty((size, size)))


@dataclass(frozen=True)
class FoundState:
    """One equilibrium that was found, in reduced coordinates ``q``."""

    q: np.ndarray
    converged: bool
    novelty: float
    iterations: int
    potential: float
    steady: bool = False  # every tangent along the path was positive definite

    def agrees(self, other: "FoundState") -> bool:
        """Whether both are the same equilibrium."""
        return (self.converged and other.converged
                and abs(self.potential - other.potential) <= 1e-6 * abs(other.potential))

    def ranking(self, settings: ReducedStaticSettings) -> tuple[bool, bool, float]:
        """Sort key: converged, then within the training, then the lower potential energy."""
        return not self.converged, self.novelty >= settings.novelty_limit, self.potential
