"""The effect of an uncertain Young's modulus on the limits of a plan.

A pose of the gripper is kept for any modulus; energy, force and stress there are not. The moduli
are log-normal. For each limited quantity, with its sign or direction, a quadratic response surface
in the logs is fitted to the full model's values at two standard deviations along each axis of the
posterior and between the axes (Box and Wilson 1951; for reliability Bucher and Bourgund 1990). It
is not fitted to a magnitude or its log: a force is the difference between the bending force and the
weight, may be small or change direction, and the curvature of its log is unbounded. Forces,
energies and stresses grow with the moduli if all grow and weight is small: the surface is fitted to
their ratio to the mean growth. The values of all poses are drawn jointly from the surfaces:
different poses break their limit under different moduli, and the motion must keep it at each.
Several limits share the remaining probability (Bonferroni).
"""

from dataclasses import dataclass, replace

import numpy as np
import scipy

from limber.core.errors import ConvergenceError, Option
from limber.core.progress import SILENT, Progress
from limber.planning.constraints.limits import Limits
from limber.planning.field.grasp_model import GraspModel, refusal
from limber.planning.field.stored_states import States
from limber.planning.path_on_full_model import ResolvedPath

_POSES = 10  # poses along the motion where a limit is near, beside the nearest ones
_NEAR = 0.3  # fraction of a limit below which it is taken as kept
_HIGH = 0.6  # fraction of the peak value: smaller ones do not break the limit first
_FAR = (2.0, 1.0)  # standard deviations at which the branch is solved; the next if it fails
_CROSSED = 6  # posterior axes of largest variance whose products are used
_DEGREES = {"strain": 0.0}  # exponent in a common factor of all moduli; default 1
_DRAWS_LOG2 = 14  # quasi-random draws (log2): the probability of 0.95 is within 0.0005


@dataclass(frozen=True)
class Risk:
    """Probability, at least ``kept``, that limits hold with uncertain moduli; by limit the possible
    peak at the given confidence over its peak on the estimate, and over the limit."""

    kept: float
    factors: dict[str, float]
    excess: dict[str, float]

    def left(self, limits: Limits, path: ResolvedPath) -> Limits:
        """Return the limits on the estimate's branch in motion with which the motion keeps
        ``limits``. As far below the limits as at standstill, at the pose nearest to each."""
        standing = path.ahead.sizes
        return limits.tightened({
            name: share * getattr(limits, name) / float(np.abs(standing[name]).max())
            for name, share in self.excess.items()})

    def exceeded_limits(self) -> list[str]:
        """Describe the limits that do not hold at the given confidence."""
        return [f"at the requested confidence, {name.replace('_', ' ')} may reach "
                f"{100 * share:.0f} % of its limit"
                for name, share in self.excess.items() if share > 1.0]


@dataclass(frozen=True)
class Surface:
    """A value at poses over changes of log E: quadratic, times the mean growth of the moduli.

    Attributes:
        whitening: From changes of log E [K] to standard deviations along the axes, shape [r, K].
        pairs: Axes with product terms, shape [p, 2].
        weights: Of 1, the axes and the products, shape [1 + r + p, n, parts]; a size is the norm
            over the parts.
        degree: Power of the mean growth.
    """

    whitening: np.ndarray
    pairs: np.ndarray
    weights: np.ndarray
    degree: float

    @classmethod
    def through(cls, axes: np.ndarray, pairs: np.ndarray, steps: np.ndarray, values: np.ndarray,
                degree: float) -> "Surface":
        """Fit it to ``values`` [m, n, parts] at ``steps`` [m, r] in standard deviations along
        ``axes`` [K, r]; as many places as weights.
        """
        grown = _growth(steps @ axes.T, degree)
        right = (values / grown[:, None, None]).reshape(len(steps), -1)
        weights = np.linalg.solve(_features(steps, pairs), right)
        return cls(np.linalg.pinv(axes), pairs, weights.reshape(values.shape), degree)

    def sizes(self, logs: np.ndarray) -> np.ndarray:
        """Return sizes under changes of log E [m, K], shape [m, n]."""
        features = _features(logs @ self.whitening.T, self.pairs)
        parts = np.tensordot(features, self.weights, axes=1)
        return _growth(logs, self.degree)[:, None] * np.linalg.norm(parts, axis=2)


def _growth(logs: np.ndarray, degree: float) -> np.ndarray:
    return np.exp(degree * logs.mean(axis=1))


def _features(steps: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    return np.column_stack([np.ones(len(steps)), steps,
                            steps[:, pairs[:, 0]] * steps[:, pairs[:, 1]]])


@dataclass(frozen=True)
class Exposure:
    """Limited quantities at poses of a motion that come near their limits; no surfaces if none
    does."""

    asked: dict[str, float]
    surfaces: dict[str, Surface]

    def risk(self, covariance: np.ndarray, confidence: float) -> Risk:
        """Return how well the motion keeps its limits if log E has this covariance [K, K]."""
        logs = _draws(covariance)
        kept, factors, excess = np.ones(len(logs), bool), {}, {}
        share = 1.0 - (1.0 - confidence) / max(len(self.asked), 1)
        for name, surface in self.surfaces.items():
            peaks, limit = surface.sizes(logs).max(axis=1), self.asked[name]
            kept &= peaks <= limit
            likely = float(np.quantile(peaks, share))
            factors[name] = likely / float(surface.sizes(np.zeros((1, logs.shape[1]))).max())
            excess[name] = likely / limit
        return Risk(float(kept.mean()), factors, excess)


def _draws(covariance: np.ndarray) -> np.ndarray:
    """Return changes of log E with this covariance [K, K], the same each time, shape [m, K]."""
    variances, axes = np.linalg.eigh(0.5 * (covariance + covariance.T))
    even = scipy.stats.qmc.Sobol(len(variances), seed=0).random_base2(_DRAWS_LOG2)
    white = scipy.special.ndtri(np.clip(even, 1e-12, 1.0 - 1e-12))
    return white * np.sqrt(np.maximum(variances, 0.0)) @ axes.T


@dataclass(frozen=True)
class YoungUncertainty:
    """Log-normal moduli: ``shares`` [tets, K] of control points in tetrahedra, rows summing to 1,
    standard deviations of log E [K], and correlation [K, K]."""

    shares: np.ndarray
    deviations: np.ndarray
    correlation: np.ndarray

    def scaled(self, grasp_model: GraspModel, logs: np.ndarray) -> GraspModel:
        """Return the branch with log E at the control points changed by ``logs`` [K]."""
        branch = grasp_model.branch
        young = branch.model.young * (self.shares @ np.exp(logs))
        return replace(grasp_model, branch=branch.with_young(young))

    def draw(self, generator: np.random.Generator) -> np.ndarray:
        """Return one draw of the changes of log E, shape [K]."""
        white = generator.multivariate_normal(np.zeros(len(self.deviations)), self.correlation)
        return self.deviations * white

    @property
    def covariance(self) -> np.ndarray:
        """Covariance of log E at the control points, shape [K, K]."""
        return self.correlation * np.outer(self.deviations, self.deviations)

    def risk(self, grasp_model: GraspModel, path: ResolvedPath, limits: Limits, confidence: float,
             progress: Progress = SILENT) -> Risk:
        """Return how a motion keeps limits with a confidence between 0.5 and 1. ConvergenceError if
        the branch with other moduli cannot be solved at a pose."""
        return self.exposure(grasp_model, path, limits, progress).risk(self.covariance, confidence)

    def exposure(self, grasp_model: GraspModel, path: ResolvedPath, limits: Limits,
                 progress: Progress = SILENT) -> "Exposure":
        """Return how the limited values change with the moduli along a motion. ConvergenceError if
        the branch with other moduli cannot be solved at a pose."""
        # With the grasp at a given position, the branch's shape hardly depends on its modulus.
        asked = limits.asked_loads()
        whole = path.approach.joined(path.solved)
        chosen = whole.take(_chosen(whole, asked))
        axes = _axes(self.covariance)
        for number, far in enumerate(_FAR):
            steps, pairs = _design(axes.shape[1], far)
            try:
                found = [chosen]
                for step in steps[1:]:
                    progress(len(found) / len(steps), "limits with other moduli")
                    found.append(self.solved(grasp_model, axes @ step, chosen))
                break
            except ConvergenceError:
                if number == len(_FAR) - 1:
                    raise
        known, surfaces = chosen.sizes, {}
        for name, limit in asked.items():
            near = np.flatnonzero(known[name] > _NEAR * limit)
            if len(near):
                values = np.array([_parts(states, name)[near] for states in found])
                surfaces[name] = Surface.through(axes, pairs, steps, values,
                                                 _DEGREES.get(name, 1.0))
        return Exposure(asked, surfaces)

    def solved(self, grasp_model: GraspModel, logs: np.ndarray, states: States,
               ) -> States:
        """Return the same poses with changed moduli, each solved from its state. ConvergenceError
        if one cannot be solved."""
        other, results = self.scaled(grasp_model, logs), []
        for pose, displacement in zip(states.poses, states.displacements, strict=True):
            result = other.follow(pose[None, :3], displacement)[0]
            if reason := refusal(result):
                position = ", ".join(f"{x:.3f}" for x in pose[:3])
                raise ConvergenceError("With another Young's modulus the branch has no acceptable "
                                       f"solution ({reason}) at ({position}) m.", "It is therefore "
                                       "unknown whether the limits hold.", "Choose a gentler goal, "
                                       "or omit ", Option("confidence"), ".").at(pose[:3])
            results.append(result)
        return States.of(other, results)


def _axes(covariance: np.ndarray) -> np.ndarray:
    """Return changes of log E by one standard deviation along the axes of the posterior that have
    any variance, the largest first, shape [K, r]."""
    variances, axes = np.linalg.eigh(0.5 * (covariance + covariance.T))
    order = np.argsort(-variances, kind="stable")
    order = order[variances[order] > 1e-12 * max(float(variances.max()), 1e-300)]
    return axes[:, order] * np.sqrt(variances[order])


def _design(count: int, far: float) -> tuple[np.ndarray, np.ndarray]:
    """Return places [m, r] along and between axes, the middle first, and the axes [p, 2] whose
    products they determine."""
    crossed = [(k, other) for k in range(min(count, _CROSSED)) for other in range(k)]
    unit = far * np.eye(count)
    between = [(unit[k] + unit[other]) / np.sqrt(2.0) for k, other in crossed]
    pairs = np.array([*((k, k) for k in range(count)), *crossed], int).reshape(-1, 2)
    return np.vstack([np.zeros((1, count)), unit, -unit, *between]), pairs


def _parts(states: States, name: str) -> np.ndarray:
    """Return a limited quantity with its sign or direction, shape [n, parts]."""
    vectors = {"force": states.forces, "torque": states.torques}
    if name in vectors:
        return vectors[name]
    return (states.energies if name == "energy" else states.loads[name])[:, None]


def _chosen(states: States, asked: dict[str, float]) -> np.ndarray:
    """Return the poses to solve: some of those that may break a limit under some moduli, evenly
    along the motion, and the pose nearest to each limit."""
    known = states.sizes
    high = np.flatnonzero(np.any([known[name] > max(_HIGH * known[name].max(), _NEAR * limit)
                                  for name, limit in asked.items()], axis=0))
    some = np.linspace(0, len(high) - 1, min(_POSES, len(high))).round().astype(int)
    return np.unique([*high[some], *(int(known[name].argmax()) for name in asked)]).astype(int)
