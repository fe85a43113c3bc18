"""Young's modulus while a pull is going on: a recursive Gauss-Newton on the reduced model.

Each frame adds its linearised residuals to what is known. A linearisation made while the moduli
were still wrong would stay wrong for ever; so a number of frames spread over the pull are kept,
and with every new one an old one is linearised again at the moduli of now.
"""

import time
from dataclasses import dataclass, field

import numpy as np
from scipy import stats

from limber.estimation.grasping import pose_on
from limber.estimation.parameters import YOUNG_BOUNDS_PA
from limber.estimation.points import point_operator
from limber.estimation.recording import GraspEntry
from limber.mechanics.reduced import ReducedModel, ReducedState

STEP_LIMIT = 0.7
"""Largest change of a log E by one frame."""
BUDGET_SECONDS = 0.033
"""An old frame is linearised again only where that fits into the time of a frame."""
ENOUGH_DEVIATION = 0.02
"""Standard deviation of every log E at which another pull adds nothing that would matter."""
ENOUGH_GAIN = 0.01
"""Or: the last tenth of the frames narrowed no interval by more than this share."""


@dataclass(frozen=True)
class OnlineFrame:
    """What was measured at one instant.

    Attributes:
        time: [s].
        pose: Of the grasp point [m, rad], shape [6].
        force: Gripper on branch [N], shape [3]; NaN where not measured.
        positions: Observed points [m], shape [m, 3]; NaN where not seen.
    """

    time: float
    pose: np.ndarray
    force: np.ndarray
    positions: np.ndarray


@dataclass(frozen=True)
class OnlineState:
    """The estimate after a frame.

    Attributes:
        time: [s].
        young: [Pa], shape [K].
        interval: 95 % [Pa], shape [K, 2].
        residual: Root mean square of this frame's standardised residuals before the update; NaN
            where the frame could not be used.
        trusted: Whether the reduced model knows such states.
        enough: Whether going on, or another pull like this one, would add nothing.
    """

    time: float
    young: np.ndarray
    interval: np.ndarray
    residual: float
    trusted: bool
    enough: bool


@dataclass
class _Kept:
    frame: OnlineFrame
    state: ReducedState
    centre: np.ndarray
    normal: np.ndarray
    gradient: np.ndarray
    count: int = 1


@dataclass
class _Known:
    normal: np.ndarray
    gradient: np.ndarray
    widths: list[np.ndarray] = field(default_factory=list)


class OnlineEstimator:
    """Takes frames one by one.

    Args:
        reduced: Reduced model of the branch held at the recorded grasp; the moduli that it was
            made around are the start.
        entry: The recorded grasp.
        mesh: The mesh of the reduced model.
        rest_points: Observed points at rest [m], shape [m, 3].
        position_sigma: Noise of points [m].
        force_sigma: Noise of the force [N].
        prior_deviation: Standard deviation of log E at the start.
        kept_count: Frames that are linearised again and again.
    """

    def __init__(self, reduced: ReducedModel, entry: GraspEntry, mesh: object,
                 rest_points: np.ndarray, *, position_sigma: float, force_sigma: float,
                 prior_deviation: float = 2.0, kept_count: int = 16):
        self.reduced, self._entry = reduced, entry
        self.rest_points = np.asarray(rest_points, float)
        operator = point_operator(mesh, self.rest_points)
        columns = reduced.basis.columns.reshape(reduced.size, -1)
        self._observe = np.asarray(operator @ columns.T)
        self._sigmas = position_sigma, force_sigma
        self.log_young = np.log(reduced.control_young)
        count = len(self.log_young)
        self._prior = self.log_young.copy(), np.eye(count) / prior_deviation**2
        self._kept: list[_Kept] = []
        self._kept_count = kept_count
        self._merged = _Known(np.zeros((count, count)), np.zeros(count))
        self._turn = 0
        self._last: ReducedState | None = None

    @property
    def covariance(self) -> np.ndarray:
        """Of log E, shape [K, K]."""
        return np.linalg.inv(self._normal_gradient()[0])

    @property
    def young(self) -> np.ndarray:
        """[Pa], shape [K]."""
        return np.exp(self.log_young)

    def update(self, frame: OnlineFrame) -> OnlineState:
        """Take a frame in; one reduced solution, and a second where time allows."""
        began = time.perf_counter()
        kept = self._linearised(frame, self._last)
        if kept is None:
            return self._state(frame.time, np.nan, False)
        self._last = kept.state
        size = max(kept.count, 1)
        residual = float(np.sqrt(self._cost(kept) / size))
        self._keep(kept)
        self._step()
        if len(self._kept) > 1 and 2.2 * (time.perf_counter() - began) < BUDGET_SECONDS:
            self._relinearise()
            self._step()
        return self._state(frame.time, residual, kept.state.trusted)

    def _linearised(self, frame: OnlineFrame, start: ReducedState | None) -> _Kept | None:
        model = self.reduced.with_young(self.young)
        pose = pose_on(self.reduced.grasp, self._entry, frame.pose)
        state = model.solve_static(pose, start=start)
        if not state.converged:
            return None
        slopes = model.sensitivities(state)
        moved = (self._observe @ state.coordinates).reshape(-1, 3)
        seen = np.isfinite(frame.positions).all(axis=1)
        rows = np.repeat(seen, 3)
        off = (self.rest_points + moved - frame.positions)[seen].ravel() / self._sigmas[0]
        jacobian = (self._observe @ slopes.coordinates)[rows] / self._sigmas[0]
        if np.isfinite(frame.force).all():
            off = np.r_[off, (state.reaction_force - frame.force) / self._sigmas[1]]
            jacobian = np.vstack([jacobian, slopes.reaction_force / self._sigmas[1]])
        # A robust share: beyond 4 deviations a residual counts less, once the fit is near.
        typical = max(1.0, 1.4826 * float(np.median(np.abs(off))) if len(off) else 1.0)
        weight = 1.0 / np.maximum(np.abs(off) / (4.0 * typical), 1.0)
        scaled = jacobian.T * weight
        return _Kept(frame, state, self.log_young.copy(), scaled @ jacobian, scaled @ off,
                     len(off))

    def _cost(self, kept: _Kept) -> float:
        """Sum of squares that is left of a frame's residual after its own best step."""
        spread = np.linalg.pinv(kept.normal, rcond=1e-10)
        return float(kept.gradient @ spread @ kept.gradient)

    def _keep(self, new: _Kept) -> None:
        self._kept.append(new)
        if len(self._kept) <= self._kept_count:
            return
        # The frame whose pose is nearest to its follower's says least of its own: it is merged.
        poses = np.array([kept.frame.pose for kept in self._kept])
        steps = np.linalg.norm(np.diff(poses[:, :3], axis=0), axis=1)
        gone = self._kept.pop(int(np.argmin(steps[:-1] + steps[1:])) + 1)
        self._merged.normal += gone.normal
        self._merged.gradient += gone.gradient - gone.normal @ gone.centre

    def _relinearise(self) -> None:
        self._turn = (self._turn + 1) % (len(self._kept) - 1)
        old = self._kept[self._turn]
        again = self._linearised(old.frame, old.state)
        if again is not None:
            self._kept[self._turn] = again

    def _normal_gradient(self) -> tuple[np.ndarray, np.ndarray]:
        """Of all that is known, at the moduli of now."""
        centre, precision = self._prior
        normal = precision + self._merged.normal
        gradient = precision @ (self.log_young - centre)
        gradient = gradient + self._merged.gradient + self._merged.normal @ self.log_young
        for kept in self._kept:
            normal = normal + kept.normal
            gradient = gradient + kept.gradient + kept.normal @ (self.log_young - kept.centre)
        return normal, gradient

    def _step(self) -> None:
        normal, gradient = self._normal_gradient()
        step = -np.linalg.solve(normal, gradient)
        step *= min(1.0, STEP_LIMIT / max(np.abs(step).max(), 1e-12))
        self.log_young = np.clip(self.log_young + step, *np.log(YOUNG_BOUNDS_PA))

    def _state(self, time: float, residual: float, trusted: bool) -> OnlineState:
        deviation = np.sqrt(np.diag(self.covariance))
        self._merged.widths.append(deviation)
        width = stats.norm.ppf(0.975) * deviation
        interval = np.exp(self.log_young[:, None] + np.column_stack([-width, width]))
        return OnlineState(time, self.young, interval, residual, trusted, self._enough())

    def _enough(self) -> bool:
        widths = self._merged.widths
        if len(widths) < 10:
            return False
        before = widths[-max(len(widths) // 10, 2)]
        gained = np.max(1 - widths[-1] / before)
        return bool(widths[-1].max() < ENOUGH_DEVIATION
                    or (gained < ENOUGH_GAIN and widths[-1].max() < 0.2))
