"""What an uncertain Young's modulus does to the limits of a plan.

A pose of the gripper is kept whatever the modulus is; energy, force and stress there are not. The
moduli are log-normal. The log of each value is taken as linear in the log moduli, its slopes from
the full model with each control point's modulus raised by one standard deviation in turn, and bent
along the way on which the worst pose comes to its limit first: there the branch is solved once more
(a design point: Ditlevsen and Madsen, Structural Reliability Methods, 1996, 5). What the values of
all poses are together is drawn from these: other poses break their limit under other moduli, and
the motion is to keep it at each. Several limits share the probability that is left (Bonferroni).
"""

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.stats import norm, qmc

from limber.errors import ConvergenceError
from limber.planning.field.grasp_model import GraspModel, refusal
from limber.planning.limits import Limits, sizes
from limber.planning.resolve import ResolvedPath, SolvedPoses
from limber.progress import SILENT, Progress

_POSES = 10  # along the motion where a limit is near, besides those where one is nearest
_NEAR = 0.3  # of a limit: what is farther below is taken to keep it
_HIGH = 0.6  # of the peak of what a limit is on: poses of less are not the first to break it
_FAR = 2.0  # standard deviations off, where the branch is solved once more
_FARTHEST = 1.5  # times as far the bend that was found there is believed
_DRAWS_LOG2 = 14  # quasi-random draws: the chance of 0.95 is off by some 0.0005


@dataclass(frozen=True)
class Risk:
    """How limits fare under uncertain moduli.

    Attributes:
        kept: Probability that all are kept along the motion, at least.
        factors: By limit: how many times its peak on the estimate it may be, with the confidence.
        excess: By limit: that over what is allowed.
    """

    kept: float
    factors: dict[str, float]
    excess: dict[str, float]

    @property
    def is_kept(self) -> bool:
        """Whether every limit is kept with the confidence."""
        return not self.told()

    def left(self, limits: Limits, path: ResolvedPath) -> Limits:
        """Return what the estimate's branch may reach in motion where the motion keeps limits.

        As far below them as standing still, at the pose where each is nearest.
        """
        standing = sizes(path.ahead)
        return limits.tightened({
            name: share * getattr(limits, name) / float(np.abs(standing[name]).max())
            for name, share in self.excess.items()})

    def told(self) -> list[str]:
        """Return in words which limits are not kept with the confidence."""
        return [f"with the confidence asked for, {name.replace('_', ' ')} may be {100 * share:.0f} "
                "% of what is allowed" for name, share in self.excess.items() if share > 1.0]


@dataclass(frozen=True)
class Exposure:
    """What limits are on, at poses of a motion that come near to them.

    Attributes:
        asked: The limits, by name.
        values: On the estimate, shape [n] each.
        slopes: Of their logs to log E at the control points, shape [n, K] each.
        bends: What the log of a value is above its slope's times that squared, shape [n] each.
        farthest: Up to which change of the log by the slope that is believed, shape [n] each.
    """

    asked: dict[str, float]
    values: dict[str, np.ndarray]
    slopes: dict[str, np.ndarray]
    bends: dict[str, np.ndarray] = field(default_factory=dict)
    farthest: dict[str, np.ndarray] = field(default_factory=dict)

    def risk(self, covariance: np.ndarray, confidence: float) -> Risk:
        """Return how the motion keeps its limits where log E has this covariance [K, K]."""
        logs = _draws(covariance)
        kept, factors, excess = np.ones(len(logs), bool), {}, {}
        share = 1.0 - (1.0 - confidence) / max(len(self.asked), 1)
        for name, limit in self.asked.items():
            if not len(self.values[name]):
                continue
            peaks = (self.values[name] * np.exp(self._changes(name, logs))).max(axis=1)
            kept &= peaks <= limit
            likely = float(np.quantile(peaks, share))
            factors[name] = likely / float(self.values[name].max())
            excess[name] = likely / limit
        return Risk(float(kept.mean()), factors, excess)

    def _changes(self, name: str, logs: np.ndarray) -> np.ndarray:
        """Return changes of the log values under draws of log E [m, K], shape [m, n]."""
        change = logs @ self.slopes[name].T
        if name not in self.bends:
            return change
        far = self.farthest[name]
        return change + self.bends[name] * np.clip(change, -far, far)**2


def _draws(covariance: np.ndarray) -> np.ndarray:
    """Return changes of log E with this covariance [K, K], the same each time, shape [m, K]."""
    variances, axes = np.linalg.eigh(0.5 * (covariance + covariance.T))
    even = qmc.Sobol(len(variances), seed=0).random_base2(_DRAWS_LOG2)
    white = norm.ppf(np.clip(even, 1e-12, 1.0 - 1e-12))
    return white * np.sqrt(np.maximum(variances, 0.0)) @ axes.T


@dataclass(frozen=True)
class YoungDoubt:
    """Moduli at control points, log-normal about the estimate.

    Attributes:
        shares: Of each control point in each tetrahedron's modulus, rows sum to 1, [tets, K].
        deviations: Of log E at the control points, shape [K].
        correlation: Shape [K, K].
    """

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
        """Of log E at the control points, shape [K, K]."""
        return self.correlation * np.outer(self.deviations, self.deviations)

    def risk(self, grasp_model: GraspModel, path: ResolvedPath, limits: Limits, confidence: float,
             progress: Progress = SILENT) -> Risk:
        """Return how a motion keeps limits with a confidence between 0.5 and 1.

        Raises:
            ConvergenceError: the branch with other moduli cannot be solved at a pose.
        """
        return self.exposure(grasp_model, path, limits, progress).risk(self.covariance, confidence)

    def exposure(self, grasp_model: GraspModel, path: ResolvedPath, limits: Limits,
                 progress: Progress = SILENT) -> "Exposure":
        """Return how what limits are on changes with the moduli along a motion.

        Raises:
            ConvergenceError: the branch with other moduli cannot be solved at a pose.
        """
        # How close the branch comes to obstacles hardly depends on its modulus.
        asked = {name: limit for name, limit in limits.asked().items() if name != "closeness"}
        whole = path.approach.joined(path.solved)
        chosen = whole.take(_chosen(whole, asked))
        known = sizes(chosen)
        slopes = self._slopes(grasp_model, chosen, asked, progress)
        per_log = np.divide(1.0, self.deviations, out=np.zeros(len(self.deviations)),
                            where=self.deviations > 0.0)
        near = {name: np.flatnonzero(known[name] > _NEAR * limit) for name, limit in asked.items()}
        straight = Exposure(asked, {name: known[name][near[name]] for name in asked},
                            {name: slopes[name][near[name]] * per_log for name in asked})
        bends, farthest = {}, {}
        for name in asked:
            if len(near[name]):
                bends[name], farthest[name] = self._bends(grasp_model, chosen.take(near[name]),
                                                          straight, name)
        return replace(straight, bends=bends, farthest=farthest)

    def _bends(self, grasp_model: GraspModel, states: SolvedPoses, straight: Exposure, name: str,
               ) -> tuple[np.ndarray, np.ndarray]:
        """Return how the log of a value bends, and how far that is believed, shape [n] each.

        By solving the states under the moduli that take the worst of them up the most.
        """
        slopes = straight.slopes[name]
        spread = np.sqrt(np.maximum(np.einsum(
            "ik,kl,il->i", slopes, self.covariance, slopes), 0.0))
        worst = int(np.argmax(straight.values[name] * np.exp(_FAR * spread)))
        if not spread[worst] > 0.0:
            return np.zeros(len(spread)), np.zeros(len(spread))
        logs = _FAR / spread[worst] * self.covariance @ slopes[worst]
        moved = sizes(self.solved(grasp_model, logs, states))[name]
        expected = slopes @ logs
        sure = np.abs(expected) > 0.5 * _FAR * spread
        off = np.log(np.maximum(moved, 1e-12) / np.maximum(straight.values[name], 1e-12)) - expected
        bends = np.divide(off, expected**2, out=np.zeros(len(off)), where=sure & (expected != 0.0))
        return bends, _FARTHEST * np.abs(expected)

    def _slopes(self, grasp_model: GraspModel, states: SolvedPoses, asked: dict[str, float],
                progress: Progress) -> dict[str, np.ndarray]:
        """Return changes of log values by a standard deviation of each modulus, [n, K] each."""
        known = sizes(states)
        found = {name: np.zeros((len(states.poses), len(self.deviations))) for name in asked}
        for k, deviation in enumerate(self.deviations):
            progress(k / len(self.deviations), "limits under other moduli")
            if deviation <= 0.0:
                continue
            logs = np.zeros(len(self.deviations))
            logs[k] = deviation
            moved = sizes(self.solved(grasp_model, logs, states))
            for name in asked:
                found[name][:, k] = np.log(np.maximum(moved[name], 1e-12)
                                           / np.maximum(known[name], 1e-12))
        return found

    def solved(self, grasp_model: GraspModel, logs: np.ndarray, states: SolvedPoses,
               ) -> SolvedPoses:
        """Return the same poses with changed moduli, each solved from its state.

        Raises:
            ConvergenceError: one cannot be solved.
        """
        other, results = self.scaled(grasp_model, logs), []
        for pose, displacement in zip(states.poses, states.displacements, strict=True):
            result = other.follow(pose[None, :3], displacement)[0]
            if reason := refusal(result):
                place = ", ".join(f"{x:.3f}" for x in pose[:3])
                raise ConvergenceError(
                    f"With another Young's modulus the branch has no acceptable solution "
                    f"({reason}) at ({place}) m.",
                    "Then it cannot be told whether the limits are kept.",
                    "Choose a gentler goal, or leave --confidence away.")
            results.append(result)
        return SolvedPoses.of(other, results)


def _chosen(states: SolvedPoses, asked: dict[str, float]) -> np.ndarray:
    """Return the poses to ask: some of those that may break a limit under some moduli, evenly along
    the motion, and where each limit is nearest."""
    known = sizes(states)
    high = np.flatnonzero(np.any([known[name] > max(_HIGH * known[name].max(), _NEAR * limit)
                                  for name, limit in asked.items()], axis=0))
    some = np.linspace(0, len(high) - 1, min(_POSES, len(high))).round().astype(int)
    return np.unique([*high[some], *(int(known[name].argmax()) for name in asked)]).astype(int)
