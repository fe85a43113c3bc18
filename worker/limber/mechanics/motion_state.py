"""One instant of a motion: the state for time steps and derivatives."""

from dataclasses import dataclass

import numpy as np


@dataclass
class MotionState:
    """One instant.

    Attributes:
        time: [s].
        displacement, velocity, acceleration: [m, m/s, m/s^2], shape [node_count, 3].
        strain, strain_before: Strain at the quadrature points now and one step earlier (or their
            derivatives), shape [tet_count, q, 6]; empty if there is no viscosity.
        step_before: Length of that step [s]; infinite if there is no earlier state.
    """

    time: float
    displacement: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray
    strain: np.ndarray
    strain_before: np.ndarray
    step_before: float = np.inf

    def rate_formula(self, dt: float) -> tuple[float, float, float]:
        """Return factors [1/s] of the next, current and previous strains in the rate after ``dt``.

        The second-order backward difference for unequal steps; first-order if there is no previous
        state.
        """
        ratio = dt / self.step_before
        return ((1 + 2 * ratio) / ((1 + ratio) * dt), -(1 + ratio) / dt,
                ratio**2 / ((1 + ratio) * dt))
