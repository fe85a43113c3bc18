"""The laws that the kernels compute themselves."""

import numpy as np

from limber.mechanics.materials.law import (
    NEO_HOOKE,
    SMALL_STRAIN,
    MaterialLaw,
    cofactor,
    contracted,
    determinant,
    hooke_stress,
    right_cauchy_green,
)


class StVenantKirchhoff(MaterialLaw):
    """The paper's law, eq. (5): quadratic in the Green-Lagrange strain."""

    name = "st_venant_kirchhoff"
    is_compiled = is_hookean = has_cubic_force = True
    softening = "where St. Venant-Kirchhoff softens: stable_neo_hookean withstands more"

    def energy(self, strain: np.ndarray, lame_lambda: np.ndarray,
               lame_mu: np.ndarray) -> np.ndarray:
        """Return lambda/2 tr(E)^2 + mu E:E."""
        return 0.5 * contracted(strain, hooke_stress(strain, lame_lambda, lame_mu))

    def stress(self, strain: np.ndarray, lame_lambda: np.ndarray,
               lame_mu: np.ndarray) -> np.ndarray:
        """Return Hooke's stress."""
        return hooke_stress(strain, lame_lambda, lame_mu)


class Linear(StVenantKirchhoff):
    """Hooke's law of the small strain, for checks; its methods take the small strain."""

    name = "linear"
    is_linear, has_cubic_force = True, False
    kernel = SMALL_STRAIN
    softening = ""

    def cauchy(self, gradient: np.ndarray, lame_lambda: np.ndarray,
               lame_mu: np.ndarray) -> np.ndarray:
        """Return Hooke's stress of the small strain."""
        eye = np.eye(3)
        small = 0.5 * (gradient + np.swapaxes(gradient, -1, -2)) - eye
        trace = np.trace(small, axis1=-2, axis2=-1)[..., None, None]
        return lame_lambda[..., None, None] * trace * eye + 2 * lame_mu[..., None, None] * small


class StableNeoHookean(MaterialLaw):
    """Smith, de Goes and Kim (2018) without the logarithmic barrier; stable in strong compression.

    Its energy is mu/2 (I_C - 3) - mu (J - 1) + (lambda + mu)/2 (J - 1)^2.
    """

    name = "stable_neo_hookean"
    is_compiled = True
    kernel = NEO_HOOKE

    def energy(self, strain: np.ndarray, lame_lambda: np.ndarray,
               lame_mu: np.ndarray) -> np.ndarray:
        """Return the energy density [J/m^3]."""
        change = np.sqrt(determinant(right_cauchy_green(strain))) - 1
        return (lame_mu * (strain[..., :3].sum(axis=-1) - change)
                + 0.5 * (lame_lambda + lame_mu) * change**2)

    def stress(self, strain: np.ndarray, lame_lambda: np.ndarray,
               lame_mu: np.ndarray) -> np.ndarray:
        """Return the second Piola-Kirchhoff stress [Pa]."""
        c = right_cauchy_green(strain)
        det = np.sqrt(determinant(c))
        pressure = ((lame_lambda + lame_mu) * (det - 1) - lame_mu) / det
        stress = pressure[..., None] * cofactor(c)
        stress[..., :3] += np.asarray(lame_mu)[..., None]
        return stress

    def cauchy(self, gradient: np.ndarray, lame_lambda: np.ndarray,
               lame_mu: np.ndarray) -> np.ndarray:
        """Return mu/J F F^T + ((lambda + mu) (J - 1) - mu) 1."""
        det = np.linalg.det(gradient)[..., None, None]
        left = gradient @ np.swapaxes(gradient, -1, -2)
        lam, mu = lame_lambda[..., None, None], lame_mu[..., None, None]
        return mu / det * left + ((lam + mu) * (det - 1) - mu) * np.eye(3)


LAWS: tuple[MaterialLaw, ...] = (StVenantKirchhoff(), StableNeoHookean(), Linear())
