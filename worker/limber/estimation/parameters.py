"""The estimated parameters and the free vector of the optimiser."""

from dataclasses import dataclass, replace

import numpy as np

YOUNG_BOUNDS_PA = (1e4, 1e11)
POISSON_BOUNDS = (0.0, 0.495)
DENSITY_BOUNDS = (50.0, 5000.0)
FORM_BOUNDS = (-5.0, 5.0)
LINK_DEVIATION = 1.2
"""Deviation of the logarithm of the ratio of two neighbouring moduli before any measurement: the
nine ratios in the paper's table have a root mean square of 1.1.
"""


@dataclass(frozen=True)
class Values:
    """Physical values of all parameters.

    Attributes:
        young: At the control points [Pa], shape [K].
        poisson: Poisson's ratio.
        density: [kg/m^3].
        damping: Rayleigh's alpha [1/s] and beta [s].
        form: Interpolation of the modulus between the control points, in deviations from the
            expected one (:mod:`limber.estimation.interpolation_prior`); empty: as expected.
    """

    young: np.ndarray
    poisson: float
    density: float
    damping: tuple[float, float] = (0.0, 0.0)
    form: tuple[float, ...] = ()


@dataclass(frozen=True)
class ParameterSpace:
    """The free parameters, and the control points that share one modulus.

    The free vector contains log E of each group, then those of the form of the field, Poisson's
    ratio, log density, log alpha and log beta that are free.

    Attributes:
        base: Values of the fixed parameters, and initial values of the free ones.
        groups: Group of each control point, shape [K]; groups are numbered from 0.
        extra: Names of the free ones: all that describe the form, named "form ...", or none; then
            out of "poisson", "density", "alpha", "beta", in this order.
        links: Pairs of groups of which the data do not determine the first: it is assumed to differ
            from the second as neighbours do.
        priors: Names out of ``extra`` with the prior of their free value: its mean and standard
            deviation.
    """

    base: Values
    groups: tuple[int, ...]
    extra: tuple[str, ...] = ()
    links: tuple[tuple[int, int], ...] = ()
    priors: tuple[tuple[str, float, float], ...] = ()

    @classmethod
    def separate(cls, base: Values, extra: tuple[str, ...] = ()) -> "ParameterSpace":
        """Every control point has a modulus of its own."""
        return cls(base, tuple(range(len(base.young))), extra)

    @property
    def group_count(self) -> int:
        return max(self.groups) + 1

    @property
    def size(self) -> int:
        return self.group_count + len(self.extra)

    @property
    def membership(self) -> np.ndarray:
        """1 if a control point is in a group, shape [K, groups]."""
        return np.eye(self.group_count)[list(self.groups)]

    @property
    def names(self) -> list[str]:
        members = [[f"E{k + 1}" for k, group in enumerate(self.groups) if group == g]
                   for g in range(self.group_count)]
        return ["=".join(group) for group in members] + list(self.extra)

    def pack(self, values: Values) -> np.ndarray:
        """Return the free vector; members of a group enter by their geometric mean."""
        member = self.membership
        young = member.T @ np.log(values.young) / member.sum(axis=0)
        form = [name for name in self.extra if name.startswith("form")]
        tail = {"poisson": values.poisson, "density": np.log(values.density),
                "alpha": np.log(max(values.damping[0], 1e-9)),
                "beta": np.log(max(values.damping[1], 1e-9)),
                **dict(zip(form, values.form or np.zeros(len(form)), strict=True))}
        return np.r_[young, [tail[name] for name in self.extra]]

    def unpack(self, free: np.ndarray) -> Values:
        """Return the physical values of a free vector."""
        free = np.asarray(free, float)
        young = np.exp(self.membership @ free[:self.group_count])
        tail = dict(zip(self.extra, free[self.group_count:], strict=True))
        alpha, beta = self.base.damping
        form = tuple(float(value) for name, value in tail.items() if name.startswith("form"))
        return Values(young, float(tail.get("poisson", self.base.poisson)),
                      float(np.exp(tail["density"])) if "density" in tail else self.base.density,
                      (float(np.exp(tail["alpha"])) if "alpha" in tail else alpha,
                       float(np.exp(tail["beta"])) if "beta" in tail else beta),
                      form or self.base.form)

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bounds of the free vector."""
        tail = {"poisson": POISSON_BOUNDS, "density": np.log(DENSITY_BOUNDS),
                "alpha": np.log((1e-6, 1e4)), "beta": np.log((1e-8, 1.0)),
                **{name: FORM_BOUNDS for name in self.extra if name.startswith("form")}}
        pairs = [np.log(YOUNG_BOUNDS_PA)] * self.group_count + [tail[name] for name in self.extra]
        lower, upper = np.array(pairs, float).T
        return lower, upper

    def link_rows(self) -> np.ndarray:
        """Standardised difference of each link, as a matrix on the free vector, [links, p]."""
        rows = np.zeros((len(self.links), self.size))
        for row, (group, neighbour) in zip(rows, self.links, strict=True):
            row[[group, neighbour]] = 1 / LINK_DEVIATION, -1 / LINK_DEVIATION
        return rows

    def own_rows(self) -> tuple[np.ndarray, np.ndarray]:
        """Prior information as standardised rows: priors, then links; R and d of R x - d.

        Shapes [priors + links, p] and [priors + links].
        """
        rows = np.zeros((len(self.priors), self.size))
        offsets = np.zeros(len(self.priors))
        for number, (name, mean, sigma) in enumerate(self.priors):
            rows[number, self.group_count + self.extra.index(name)] = 1 / sigma
            offsets[number] = mean / sigma
        links = self.link_rows()
        return np.vstack([rows, links]), np.r_[offsets, np.zeros(len(links))]

    @property
    def own_row_count(self) -> int:
        return len(self.priors) + len(self.links)

    def linked(self, links: tuple[tuple[int, int], ...]) -> "ParameterSpace":
        """Return the space with these links instead of its own."""
        return replace(self, links=links)

    def on_bound(self, free: np.ndarray, share: float = 1e-3) -> list[str]:
        """Names of the free values at a bound."""
        lower, upper = self.bounds()
        width = share * (upper - lower)
        at = (free <= lower + width) | (free >= upper - width)
        return [name for name, flag in zip(self.names, at, strict=True) if flag]


def equal_values(one: Values | None, other: Values) -> bool:
    """Whether all parameters are the same."""
    return one is not None and np.array_equal(one.young, other.young) and (
        (one.poisson, one.density, one.damping, one.form)
        == (other.poisson, other.density, other.damping, other.form))


def mechanics_names(extra: tuple[str, ...]) -> tuple[str, ...]:
    """Return the parameters by their names in :mod:`limber.mechanics.sensitivities`."""
    names = {"poisson": "poisson", "density": "log_density", "alpha": "damping_mass",
             "beta": "damping_stiffness"}
    # Parameters of the field's form come with log E.
    return ("log_young", *(names[name] for name in extra if name in names))
