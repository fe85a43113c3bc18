"""One instant of a motion: what dynamics steps through and its derivatives are taken of."""

from dataclasses import dataclass

import numpy as np


@dataclass
class MotionState:
    """One instant.

    Attributes:
        time: [s].
        displacement, velocity, acceleration: [m, m/s, m/s^2], shape [node_count, 3].
        strain, strain_before: At the quadrature points now and a step before (or their
            derivatives), shape [tet_count, q, 6]; empty where there is no viscosity.
        step_before: That step [s]; infinite where nothing is known of before.
    """

    time: float
    displacement: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray
    strain: np.ndarray
    strain_before: np.ndarray
    step_before: float = np.inf

    def rate_formula(self, dt: float) -> tuple[float, float, float]:
        """Return factors [1/s] of the strains next, now and before in the rate after ``dt``.

        The second-order backward difference for unequal steps; of first order without a past.
        """
        ratio = dt / self.step_before
        return ((1 + 2 * ratio) / ((1 + ratio) * dt), -(1 + ratio) / dt,
                ratio**2 / ((1 + ratio) * dt))
