"""A swing by the lowest modes of the branch: a millisecond for what the full model takes seconds.

The branch vibrates about the equilibrium at the end, from the shape in which it was released. Both
are columns of the basis beside the modes, so that beginning and end are exact for small factors on
modulus and density, and the vibration between them is that of the linear branch. A fit by modes is
corrected by the full model's difference at its result, which changes little with the parameters.
"""

from dataclasses import dataclass

import numpy as np
import scipy
from scipy import sparse

from limber.mechanics.dynamics.modes import lowest_modes
from limber.mechanics.model import BranchModel

MODES = 10
"""Modes of a swing: six more than what 40 steps a period show."""
STEP = 1e-4
"""Step of the central differences in the logarithms."""
_DENSITY_STEP = 1e-2
_SAME = 1e-6  # norm of a column that the others already contain


@dataclass(frozen=True)
class Ends:
    """Equilibria at the release and at the end of a swing.

    Attributes:
        begin: Displacement at the release [m], shape [n, 3]; zero: held in its shape at rest.
        end: Displacement in which the branch comes to rest [m], shape [n, 3].
    """

    begin: np.ndarray
    end: np.ndarray


class ModalSwing:
    """Displacements of the markers in small vibrations.

    Args:
        model: The branch, with undamped values about which the factors count.
        ends: Its equilibria.
        denser: The same for a branch of 1 % more density.
        operator: Displacements of the markers from those of the nodes, shape [3 m, 3 n].
    """

    def __init__(self, model: BranchModel, ends: Ends, denser: Ends, operator: sparse.csr_matrix):
        shapes = lowest_modes(model, MODES, ends.end).shapes
        basis = _independent(model, [*shapes, ends.end, ends.begin])
        stiff = np.array([model.tangent_times(ends.end, column).ravel() for column in basis])
        flat = basis.reshape(len(basis), -1)
        own = model.without_point_masses()
        masses = np.array([model.mass_times(column).ravel() for column in basis])
        body = np.array([own.mass_times(column).ravel() for column in basis])
        self._stiffness, self._body = flat @ stiff.T, flat @ body.T
        self._added = flat @ masses.T - self._body
        # Forces that hold begin and end, and their change with the logarithm of the density.
        self._forces = [(stiff @ at.ravel(), stiff @ (then - at).ravel() / np.log1p(_DENSITY_STEP))
                        for at, then in ((ends.begin, denser.begin), (ends.end, denser.end))]
        self._seen = (operator @ flat.T).reshape(-1, 3, len(basis))

    def moved(self, times: np.ndarray, stretch: float, damping: tuple[float, float],
              heavier: float, creep: tuple[float, float] = (0.0, 1.0)) -> np.ndarray:
        """Return the markers' displacements from the shape at rest [m], shape [f, m, 3].

        Args:
            times: Since the release [s], shape [f].
            stretch: Logarithm of the factor on the modulus.
            damping: Rayleigh's alpha [1/s] and beta [s].
            heavier: Logarithm of the factor on the density.
            creep: Share of the stiffness that a lasting load relaxes, and its time constant [s].
        """
        stiffness = np.exp(stretch) * self._stiffness
        squares, shapes = scipy.linalg.eigh(stiffness, np.exp(heavier) * self._body + self._added)
        begin, end = (np.linalg.solve(stiffness, force + heavier * change)
                      for force, change in self._forces)
        start = np.linalg.solve(shapes, begin - end)
        squares, decay = np.maximum(squares, 0.0), 0.5 * (damping[0] + damping[1] * squares)
        course = (_creeping(times, squares, decay, *creep) if creep[0]
                  else _released(times[:, None], squares, decay))
        # Both ends were held long enough to be relaxed.
        return np.einsum("mip,fp->fmi", self._seen,
                         (course * start) @ shapes.T + end) / (1 - creep[0])

    def slopes(self, times: np.ndarray, stretch: float, damping: tuple[float, float],
               heavier: float, creep: tuple[float, float] | None = None) -> np.ndarray:
        """Return derivatives to log factor, log alpha, log beta and log density, [f, m, 3, 4]; with
        creep also to its share, [f, m, 3, 5].
        """
        share, seconds = creep or (0.0, 1.0)
        centre = np.array([stretch, *np.log(damping), heavier, share])
        columns = []
        for step in STEP * np.eye(5)[:4 if creep is None else 5]:
            ahead, behind = (self.moved(times, at[0], (np.exp(at[1]), np.exp(at[2])), at[3],
                                        (at[4], seconds))
                             for at in (centre + step, centre - step))
            columns.append((ahead - behind) / (2 * STEP))
        return np.stack(columns, axis=-1)

    @staticmethod
    def denser(model: BranchModel) -> BranchModel:
        """Return the model with the density of the argument ``denser``."""
        return model.with_parameters(density=model.density * (1 + _DENSITY_STEP))


def _released(times: np.ndarray, squares: np.ndarray, decay: np.ndarray) -> np.ndarray:
    """Return oscillators that start at 1 without speed; overdamped ones too.

    Args:
        times: [s], shape [f, 1].
        squares: Squared angular frequencies without damping [1/s^2], shape [k].
        decay: Rates of decay [1/s], shape [k].
    """
    root = np.sqrt((decay**2 - squares).astype(complex))
    # At the limit of overdamping both roots are equal, and the motion is the same beside it.
    root = np.where(np.abs(root) < 1e-6 * np.sqrt(squares), 1e-6 * np.sqrt(squares), root)
    fast = -(decay + root)
    slow = squares / fast
    return ((slow * np.exp(fast * times) - fast * np.exp(slow * times)) / (slow - fast)).real


def _creeping(times: np.ndarray, squares: np.ndarray, decay: np.ndarray, share: float,
              seconds: float) -> np.ndarray:
    """Return such oscillators of standard linear solids, shape [f, k]: part of the spring force
    follows the motion late, y'' + 2 d y' + w^2 (y - share z) = 0 with z' = (y - z) / seconds.
    """
    system = np.zeros((len(squares), 3, 3))
    system[:, 0, 1] = 1.0
    system[:, 1] = np.column_stack([-squares, -2 * decay, share * squares])
    system[:, 2, [0, 2]] = 1 / seconds, -1 / seconds
    rates, shapes = np.linalg.eig(system)
    parts = np.linalg.solve(shapes, np.tile([[1.0], [0.0], [1.0]], (len(squares), 1, 1)))[..., 0]
    return np.einsum("kr,fkr->fk", shapes[:, 0] * parts,
                     np.exp(times[:, None, None] * rates)).real


def _independent(model: BranchModel, columns: list[np.ndarray]) -> np.ndarray:
    """Return the columns made orthogonal in the mass; without those that others contain."""
    kept: list[np.ndarray] = []
    for column in columns:
        size = _norm(model, column)
        if size == 0.0:
            continue
        column = column / size
        for _ in range(2):
            for other in kept:
                column = column - np.vdot(other, model.mass_times(column)) * other
        left = _norm(model, column)
        if left > _SAME:
            kept.append(column / left)
    return np.array(kept)


def _norm(model: BranchModel, column: np.ndarray) -> float:
    return float(np.sqrt(max(np.vdot(column, model.mass_times(column)), 0.0)))
