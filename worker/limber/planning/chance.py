"""What an uncertain Young's modulus does to the limits of a plan.

A pose of the gripper is kept whatever the modulus is; energy, force and stress there are not. With
the moduli log-normal, the log of each is taken as linear in the log moduli: its slopes come from
the full model, with each control point's modulus raised by one standard deviation in turn, at
poses along the motion. So a value stays below ``exp(z s)`` times its own with the probability of
``z``, where ``s^2 = g^T C g``. Several limits share the probability that is left (Bonferroni).
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import norm

from limber.errors import ConvergenceError
from limber.planning.field.grasp_model import GraspModel, refusal
from limber.planning.limits import Limits, sizes
from limber.planning.resolve import ResolvedPath, SolvedPoses
from limber.progress import SILENT, Progress

_POSES = 10  # along the motion, besides those where a limit is nearest
_NEAR = 0.3  # of a limit: what is farther below is taken to keep it


@dataclass(frozen=True)
class Risk:
    """How limits fare under uncertain moduli.

    Attributes:
        kept: Probability that all are kept along the motion, at least.
        factors: By limit: how many times its value on the estimate it may be, with the confidence.
        excess: By limit: that over what is allowed, at its worst pose.
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
    """

    asked: dict[str, float]
    values: dict[str, np.ndarray]
    slopes: dict[str, np.ndarray]

    def risk(self, covariance: np.ndarray, confidence: float) -> Risk:
        """Return how the motion keeps its limits where log E has this covariance [K, K]."""
        lost, factors, excess = 0.0, {}, {}
        z = norm.ppf(1.0 - (1.0 - confidence) / max(len(self.asked), 1))
        for name, limit in self.asked.items():
            rows, values = self.slopes[name], self.values[name]
            if not len(values):
                continue
            spread = np.sqrt(np.maximum(np.einsum("ik,kl,il->i", rows, covariance, rows), 1e-18))
            lost += float(norm.sf(np.log(limit / values) / spread).max())
            worst = int(np.argmax(values * np.exp(z * spread)))
            factors[name] = float(np.exp(z * spread).max())
            excess[name] = float((values * np.exp(z * spread))[worst] / limit)
        return Risk(max(1.0 - lost, 0.0), factors, excess)


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
        near = {name: known[name] > _NEAR * limit for name, limit in asked.items()}
        return Exposure(asked, {name: known[name][near[name]] for name in asked},
                        {name: slopes[name][near[name]] * per_log for name in asked})

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
    """Return the poses to ask: some along the motion, and where each limit is nearest."""
    some = np.linspace(0, len(states.poses) - 1, min(_POSES, len(states.poses))).round()
    known = sizes(states)
    return np.unique([*some.astype(int), *(int(known[name].argmax()) for name in asked)])
