"""A hyperelastic material law: an energy and its derivatives.

A law is a subclass of :class:`MaterialLaw` with a name and an energy density:

>>> from limber.mechanics.materials.laws import MaterialLaw
>>> class Cubic(MaterialLaw):
...     name = "cubic"
...     def energy(self, strain, lame_lambda, lame_mu):
...         trace = strain[..., :3].sum(axis=-1)
...         squares = (strain**2 @ [1.0, 1, 1, 2, 2, 2])
...         return 0.5 * lame_lambda * (trace**2 + trace**3) + lame_mu * squares

:func:`~limber.mechanics.materials.laws.register_material` registers it by its name.
Tensors are written in one row, 00 11 22 01 02 12.
"""

import hashlib
import re
from importlib.metadata import entry_points

import numpy as np

from limber.core.errors import InputError

GREEN_STRAIN, NEO_HOOKE, SMALL_STRAIN = 0, 1, 2
"""Laws that the compiled kernels distinguish: Hooke's stress of the Green-Lagrange strain, the
stable neo-Hookean stress, Hooke's stress of the small strain.
"""

UNIT = np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
MULTIPLICITY = np.array([1.0, 1.0, 1.0, 2.0, 2.0, 2.0])
"""Multiplicity of each number of the row in the tensor; a shear angle is twice its strain."""
_ONE_EACH = np.diag(1 / MULTIPLICITY)
"""Strains in which one component, or one shear angle, is 1."""
_IMAGINARY = 1e-30
_STEP = 1e-6
"""Step of central differences: its square is as far below 1 as the round-off of a difference."""
_TRIED = 0.02
"""Size of the strains at which a new law is checked."""


class MaterialLaw:
    """A hyperelastic law of the Green-Lagrange strain.

    The energy must be linear in both Lamé coefficients together, so that all stiffness is
    proportional to Young's modulus: estimates and sensitivities depend on that. A law's own
    constants are therefore dimensionless. Arrays: ``strain`` has shape [..., 6]; ``lame_lambda``
    and ``lame_mu`` [Pa] broadcast to [...].

    Attributes:
        name: Name in settings and commands.
        is_linear: Small strains: a carried weight has no effect, and there are no snaps.
        is_hookean: The stress is lambda tr(E) 1 + 2 mu E of the law's strain.
        has_cubic_force: The force is a cubic polynomial of the displacement; mixed-point Newton and
            the reduced model depend on that.
        is_compiled: The kernels compute it themselves. All others are computed by the methods
            here, and Hooke's kernel takes their stress.
        kernel: Law that the kernels compute; if not compiled, the one that takes its stress.
        softening: Message to a user who has compressed it too far; empty: none.
    """

    name: str
    is_linear = False
    is_hookean = False
    has_cubic_force = False
    is_compiled = False
    kernel = GREEN_STRAIN
    softening = ""

    def energy(self, strain: np.ndarray, lame_lambda: np.ndarray,
               lame_mu: np.ndarray) -> np.ndarray:
        """Return the energy density [J/m^3], shape [...].

        If :meth:`stress` is not overridden, the energy is differentiated by a complex step: the
        formula must accept complex strain and be analytic (no ``abs``, no comparison). A law that
        also defines its stress is several times as fast.
        """
        raise NotImplementedError

    def stress(self, strain: np.ndarray, lame_lambda: np.ndarray,
               lame_mu: np.ndarray) -> np.ndarray:
        """Return the second Piola-Kirchhoff stress [Pa], shape [..., 6]; exact by default."""
        steps = np.expand_dims(_ONE_EACH, tuple(range(1, np.ndim(strain))))
        moved = self.energy(strain + 1j * _IMAGINARY * steps, lame_lambda, lame_mu)
        return np.moveaxis(moved.imag, 0, -1) / _IMAGINARY

    def stress_change(self, strain: np.ndarray, change: np.ndarray, lame_lambda: np.ndarray,
                      lame_mu: np.ndarray) -> np.ndarray:
        """Return the derivative of the stress along ``change`` of the strain, shapes [..., 6].

        Default: a difference of the stress, to about ten digits.
        """
        size = np.abs(change).max(axis=-1, keepdims=True)
        step = _STEP * change / np.where(size > 0, size, 1.0)
        return (self.stress(strain + step, lame_lambda, lame_mu)
                - self.stress(strain - step, lame_lambda, lame_mu)) * (size / (2 * _STEP))

    def moduli(self, strain: np.ndarray, lame_lambda: np.ndarray,
               lame_mu: np.ndarray) -> np.ndarray:
        """Return the derivative of the stress to 00 11 22 and the shear angles 01 02 12 [Pa].

        Shape [..., 6, 6]. Default: from :meth:`stress_change`.
        """
        changes = np.stack([self.stress_change(strain, step, lame_lambda, lame_mu)
                            for step in _ONE_EACH], axis=-1)
        return 0.5 * (changes + np.swapaxes(changes, -1, -2))

    def cauchy(self, gradient: np.ndarray, lame_lambda: np.ndarray,
               lame_mu: np.ndarray) -> np.ndarray:
        """Return the Cauchy stress [Pa] at a deformation gradient, both [..., 3, 3]."""
        turned = np.swapaxes(gradient, -1, -2)
        green = 0.5 * (turned @ gradient - np.eye(3))
        row = self.stress(green[..., [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]],
                          lame_lambda, lame_mu)
        # The memory order determines the summation order of products, hence the last digits.
        stress = np.ascontiguousarray(row[..., [[0, 3, 4], [3, 1, 5], [4, 5, 2]]])
        return gradient @ stress @ turned / np.linalg.det(gradient)[..., None, None]


def hooke_stress(strain: np.ndarray, lame_lambda: np.ndarray,
                 lame_mu: np.ndarray) -> np.ndarray:
    """Return Hooke's stress lambda tr(E) 1 + 2 mu E [Pa]; arguments as for a law."""
    trace = strain[..., :3].sum(axis=-1, keepdims=True)
    return lame_lambda[..., None] * trace * UNIT + 2 * lame_mu[..., None] * strain


def hooke_strain(stress: np.ndarray, lame_lambda: np.ndarray,
                 lame_mu: np.ndarray) -> np.ndarray:
    """Return the strain for which this is Hooke's stress [Pa]; arguments as for a law."""
    trace = stress[..., :3].sum(axis=-1, keepdims=True)
    spread = (lame_lambda / (3 * lame_lambda + 2 * lame_mu))[..., None] * trace
    return (stress - spread * UNIT) / (2 * lame_mu[..., None])


def contracted(one: np.ndarray, two: np.ndarray) -> np.ndarray:
    """Return the double contraction of symmetric tensors [..., 6], shape [...]."""
    product = one * two
    return product[..., :3].sum(axis=-1) + 2 * product[..., 3:].sum(axis=-1)


def right_cauchy_green(strain: np.ndarray) -> np.ndarray:
    """Return C = 1 + 2 E, both [..., 6]."""
    return 2 * strain + UNIT


def cofactor(c: np.ndarray) -> np.ndarray:
    """Return the cofactors of symmetric tensors [..., 6]: determinant times inverse."""
    c00, c11, c22, c01, c02, c12 = np.moveaxis(c, -1, 0)
    return np.stack([c11 * c22 - c12**2, c00 * c22 - c02**2, c00 * c11 - c01**2,
                     c02 * c12 - c01 * c22, c01 * c12 - c02 * c11, c01 * c02 - c12 * c00], axis=-1)


def determinant(c: np.ndarray) -> np.ndarray:
    """Return the determinants of symmetric tensors [..., 6], shape [...]."""
    return (c[..., [0, 3, 4]] * cofactor(c)[..., [0, 3, 4]]).sum(axis=-1)


def is_hookean_at_rest(law: MaterialLaw) -> bool:
    """Whether the law's moduli at zero strain are those of Young's modulus and Poisson's ratio."""
    lam, mu = np.array(1.5), np.array(1.0)
    hooke = np.stack([hooke_stress(step, lam, mu) for step in _ONE_EACH], axis=-1)
    return bool(np.abs(law.moduli(np.zeros(6), lam, mu) - hooke).max() < 1e-6)


def law_digest(law: MaterialLaw) -> str:
    """Return a digest of a law's values at a few strains; it changes with the law."""
    strain, lam, mu = _tried()
    values = [law.energy(strain, lam, mu), *law.stress(strain, lam, mu).T]
    return hashlib.sha256(" ".join(f"{value:.9e}" for value in np.ravel(values)).encode()
                          ).hexdigest()


def check_law(law: MaterialLaw) -> None:
    """Check an external law at a few strains. InputError if it has stress at rest, wrong
    derivatives, is not linear in the Lamé coefficients, or is unstable at rest."""
    strain, lam, mu = _tried()
    other = lam[::-1]
    energy = law.energy(strain, lam, mu)
    if np.shape(energy) != (8,) or not np.isfinite(energy).all():
        raise _wrong(law, f"gives an energy of shape {np.shape(energy)}, or one that is not "
                     "finite, for strains of shape (8, 6)",
                     "Return one finite number for each strain.")
    rest = np.zeros((8, 6))
    if np.abs(law.stress(rest, lam, mu)).max() > 1e-9 or np.abs(
            law.energy(rest, lam, mu)).max() > 1e-9:
        raise _wrong(law, "has energy or stress at zero strain",
                     "Add terms that make both 0 there.")
    if not np.allclose(law.stress(strain, lam, mu), _slopes(law, strain, lam, mu), atol=1e-7):
        raise _wrong(law, "gives a stress that is not the derivative of its energy",
                     "Do not use abs, conjugate or comparisons of the strain in the energy, or "
                     "give the stress. The derivative with respect to a shear strain counts half.")
    change = MaterialLaw.stress_change(law, strain, strain, lam, mu)
    by_moduli = np.einsum("nkl,nl->nk", law.moduli(strain, lam, mu), strain * MULTIPLICITY)
    if not (np.allclose(by_moduli, change, rtol=1e-5, atol=1e-8) and np.allclose(
            law.stress_change(strain, strain, lam, mu), change, rtol=1e-5, atol=1e-8)):
        raise _wrong(law, "gives moduli that are not the derivative of its stress",
                     "Their columns are derivatives with respect to the shear angles, which are "
                     "twice the shear strains.")
    if not np.allclose(law.energy(strain, lam + 2 * other, mu + 2 * mu),
                       energy + 2 * law.energy(strain, other, mu), rtol=1e-9, atol=1e-15):
        raise _wrong(law, "is not linear in both Lamé coefficients",
                     "Express its own constants as ratios to them.")
    if np.linalg.eigvalsh(law.moduli(rest, lam, mu)).min() <= 0:
        raise _wrong(law, "is not stable at zero strain", "Its moduli must be positive there.")


def _tried() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Strains [8, 6] and Lamé coefficients [8] at which external laws are checked."""
    rng = np.random.default_rng(0)
    lam, mu = rng.uniform(1.0, 3.0, (2, 8))
    return _TRIED * rng.standard_normal((8, 6)), lam, mu


def _slopes(law: MaterialLaw, strain: np.ndarray, lam: np.ndarray, mu: np.ndarray) -> np.ndarray:
    return np.stack([(law.energy(strain + _STEP * step, lam, mu)
                      - law.energy(strain - _STEP * step, lam, mu)) / (2 * _STEP)
                     for step in _ONE_EACH], axis=-1)


def _wrong(law: MaterialLaw, what: str, remedy: str) -> InputError:
    return InputError(f"The material {law.name!r} {what}.",
                      "Solvers would not find the states of least energy.", remedy)


# The laws that the kernels compute themselves.


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
    Its energy is mu/2 (I_C - 3) - mu (J - 1) + (lambda + mu)/2 (J - 1)^2."""

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


# Material laws by name: built-in and external.
#
# An external law is known to a program that calls :func:`register_material`. An installed package
# registers its laws for every command by the entry point group ``limber.materials``: a name, and
# the location of an object or class of :class:`~limber.mechanics.materials.laws.MaterialLaw`. Heavy
# imports are delayed until a law is requested.

BUILT_IN = ("st_venant_kirchhoff", "stable_neo_hookean", "linear")
_GROUP = "limber.materials"
_registered: dict[str, "MaterialLaw"] = {}


def register_material(law: "MaterialLaw") -> "MaterialLaw":
    """Register a law under its name, replacing an earlier external one; return it.

    Raises:
        InputError: the name cannot be an option's value or is a built-in law's, the law claims a
            property reserved for built-in laws, or its methods are inconsistent (see
            :func:`limber.mechanics.materials.laws.check_law`).
    """

    name = getattr(law, "name", "")
    if not re.fullmatch(r"[a-z]\w*", name) or name in BUILT_IN:
        raise InputError(f"{name!r} is not a valid material name.",
                         "A name has only lower-case letters, digits and _, and differs from the "
                         "built-in names.",
                         "Choose another.")
    if law.is_compiled or law.is_linear or law.is_hookean or law.has_cubic_force or law.kernel:
        raise InputError(f"The material {name!r} declares itself built-in.",
                         "The kernels do not implement it.", "Do not change those attributes.")
    check_law(law)
    _registered[name] = law
    return law


def material_names() -> tuple[str, ...]:
    """Return the names of all laws; imports none of them."""
    return tuple(dict.fromkeys((*BUILT_IN, *_registered, *entry_points(group=_GROUP).names)))


def material_named(name: "str | MaterialLaw") -> "MaterialLaw":
    """Return the law of that name; a law is returned unchanged. InputError if there is no law of
    that name, or a package's law cannot be used."""
    if not isinstance(name, str):
        return name
    if name in BUILT_IN:

        return LAWS[BUILT_IN.index(name)]
    if name in _registered:
        return _registered[name]
    for entry in entry_points(group=_GROUP, name=name):
        found = entry.load()
        law = found() if isinstance(found, type) else found
        if law.name != name:
            raise InputError(f"{entry.value} has the name {law.name!r}, not {name!r}.",
                             "Its entry point has a different name.", "Give both the same name.")
        return register_material(law)
    raise InputError(f"There is no material {name!r}.", "The known materials are: "
                     + ", ".join(material_names()) + ".",
                     "Choose one, or register it (limber.mechanics.register_material).")
