"""Young's modulus during a pull: recursive Gauss-Newton with the reduced model.

Each frame adds its linearised residuals to the information. A linearisation made while the moduli
were still wrong would stay wrong forever. Therefore a number of frames spread over the pull are
kept, and with every new one an old one is linearised again at the current moduli.

The error of the reduced model is measured in parallel (:mod:`limber.estimation.online.filter`):
the full model at a few of the kept frames, interpolated between them. The error of the earlier
frames' prediction of a new one widens the intervals: an error of the model is the same in all
frames, and does not average out as noise does.
"""

import time
from concurrent.futures import Future
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy

from limber.core.not_none import present
from limber.core.processes import Pool
from limber.estimation.parameters import YOUNG_BOUNDS_PA
from limber.geometry.tets.tet_mesh import TetMesh
from limber.mechanics.added_masses import PointMass
from limber.mechanics.model import BranchModel
from limber.mechanics.points import point_operator
from limber.mechanics.sensitivities import static_sensitivities
from limber.mechanics.statics.solve import solve_static
from limber.recordings.recording import GraspEntry, grasp_on, pose_on
from limber.reduced import reduced_model
from limber.reduced.model_cache import reduce_snapshots
from limber.reduced.training import Trainer, sample_young

# The full model for an online estimate: single frames, solved in another process.
#
# The reduced model answers within a frame's time, but outside its training range its error
# exceeds the sensors' noise. The full model needs longer than a frame but not longer than a pull:
# its solutions at some frames correct the reduced model at all of them.

REFRESH_STATES = 24
"""Full solutions of a basis that is made during a pull."""
REFRESH_SPREAD = 1.5
"""Factor in Young's modulus within which they are sampled. Chosen, not measured, as for a fit."""


@dataclass(frozen=True)
class ExactFrame:
    """A frame of the full model at log E [K]: points' displacement [m, 3] [m], the gripper's force
    on the branch [3] [N], and derivatives [m, 3, K] and [3, K]."""

    log_young: np.ndarray
    moved: np.ndarray
    force: np.ndarray
    d_moved: np.ndarray
    d_force: np.ndarray


@dataclass(frozen=True)
class FullBranch:
    """The full model at a recorded grasp, as data for a process; ``weights`` [tet_count, K] are
    from control points to tetrahedra. ``hangs``: the mesh includes bending by weight."""

    mesh: TetMesh
    weights: np.ndarray
    entry: GraspEntry
    rest_points: np.ndarray
    poisson: float
    density: float
    gravity: tuple[float, float, float]
    point_masses: tuple[PointMass, ...] = ()
    hangs: bool = False

    def model(self, young: np.ndarray) -> BranchModel:
        """Return the branch with these moduli at the control points [Pa]."""
        model = BranchModel(self.mesh, young=self.weights @ young, poisson=self.poisson,
                            density=self.density, gravity=self.gravity,
                            point_masses=self.point_masses)
        return model.as_scanned() if self.hangs else model


class ExactSolver:
    """Solves frames of the full model, and makes bases of them."""

    def __init__(self, branch: FullBranch):
        self.branch = branch
        self.grasp = grasp_on(branch.mesh, branch.entry)
        self._model = branch.model(np.ones(branch.weights.shape[1])).gripped(self.grasp)
        self._operator = point_operator(branch.mesh, branch.rest_points)

    def frame(self, pose: np.ndarray, log_young: np.ndarray,
              start: np.ndarray) -> ExactFrame | None:
        """Solve a recorded pose [m, rad] from displacements [m]; None without equilibrium."""
        young = np.exp(log_young)
        model = self._model.with_young(self.branch.weights @ young)
        result = solve_static(model, grasp=self.grasp, start=start,
                              pose=pose_on(self.grasp, self.branch.entry, pose))
        if not result.converged:
            return None
        slopes = static_sensitivities(model, result, self.grasp, self.branch.weights,
                                      control_young=young)
        count = len(young)
        return ExactFrame(
            log_young.copy(), (self._operator @ result.displacement.ravel()).reshape(-1, 3),
            result.reaction_force,
            (self._operator @ slopes.displacement.reshape(-1, count)).reshape(-1, 3, count),
            slopes.reaction_force)

    def basis(self, poses: np.ndarray, log_young: np.ndarray) -> reduced_model.ReducedModel:
        """Make a reduced model from full solutions at recorded poses, around ``log_young``."""
        young = np.exp(log_young)
        model = self._model.with_young(self.branch.weights @ young)
        poses = np.resize(poses, (max(len(poses), REFRESH_STATES), 6))
        held = np.array([pose_on(self.grasp, self.branch.entry, pose) for pose in poses])
        trainer = Trainer(model, self.grasp, self.branch.weights, young)
        sampled = sample_young(young, len(held), np.random.default_rng(0), REFRESH_SPREAD)
        snapshots = trainer.take(held, sampled)
        return reduce_snapshots(model, self.grasp, self.branch.weights, young, snapshots,
                                reduced_model.ReducedSettings())


class Beside:
    """Runs an :class:`ExactSolver` in a separate process; close it, or use it in a ``with``."""

    def __init__(self, branch: FullBranch):
        self._pool = Pool(1, begin=_begin, begin_arguments=(branch,),
                          name="the full model beside an online estimate")

    def frame(self, *arguments: np.ndarray) -> "Future[ExactFrame | None]":
        return self._pool.submit(_asked, "frame", *arguments)

    def basis(self, *arguments: np.ndarray) -> "Future[reduced_model.ReducedModel]":
        return self._pool.submit(_asked, "basis", *arguments)

    def close(self) -> None:
        self._pool.close()

    def __enter__(self) -> "Beside":
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()


_solver: list[ExactSolver] = []


def _begin(branch: FullBranch) -> None:
    _solver[:] = [ExactSolver(branch)]


def _asked(name: str, *arguments: np.ndarray) -> Any:
    return getattr(_solver[0], name)(*arguments)


# Information of the frames of a pull on the moduli: linearised and summed.


@dataclass(frozen=True)
class OnlineFrame:
    """Measurements at one instant: pose of the grasp point [6] [m, rad], force on the branch [3]
    and points [m, 3], NaN where not measured."""

    time: float
    pose: np.ndarray
    force: np.ndarray
    positions: np.ndarray


@dataclass
class Kept:
    """A frame as linearised at ``centre``, log E [K]: normal matrix [K, K] and gradient [K] of half
    its squared residuals, and their RMS. ``state`` is None if it belongs to another basis."""

    frame: OnlineFrame
    state: reduced_model.ReducedState | None
    centre: np.ndarray
    normal: np.ndarray
    gradient: np.ndarray
    residual: float


class Information:
    """Information on log E: a prior about ``centre`` [K], merged frames, and at most ``kept_count``
    frames kept for another linearisation."""

    def __init__(self, centre: np.ndarray, deviation: float, kept_count: int):
        count = len(centre)
        self._prior = centre.copy(), np.eye(count) / deviation**2
        self._kept_count = kept_count
        self.kept: list[Kept] = []
        self.past: list[OnlineFrame] = []
        self._normal, self._gradient = np.zeros((count, count)), np.zeros(count)

    def add(self, new: Kept) -> None:
        """Keep a frame; if there are too many, the least informative one is merged."""
        self.kept.append(new)
        self.kept.sort(key=lambda kept: kept.frame.time)
        if len(self.kept) <= self._kept_count:
            return
        # The frame whose pose is nearest to its neighbours' adds the least information: it is
        # merged.
        poses = np.array([kept.frame.pose for kept in self.kept])
        steps = np.linalg.norm(np.diff(poses[:, :3], axis=0), axis=1)
        gone = self.kept.pop(int(np.argmin(steps[:-1] + steps[1:])) + 1)
        self.past.append(gone.frame)
        self._normal += gone.normal
        self._gradient += gone.gradient - gone.normal @ gone.centre

    def replace(self, kept: list[Kept]) -> None:
        """Replace all kept and merged frames by these."""
        self.kept, self.past = kept, []
        self._normal[:], self._gradient[:] = 0.0, 0.0

    def normal_gradient(self, log_young: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Normal matrix and gradient of all information, at these moduli: shapes [K, K] and [K]."""
        centre, precision = self._prior
        normal = precision + self._normal
        gradient = precision @ (log_young - centre)
        gradient = gradient + self._gradient + self._normal @ log_young
        for kept in self.kept:
            normal = normal + kept.normal
            gradient = gradient + kept.gradient + kept.normal @ (log_young - kept.centre)
        return normal, gradient


# Errors of the reduced model at some frames of a pull, and their interpolation.

UNCHECKED_ERROR = 0.3
"""Initial error of the reduced model over the noise of a measurement, before it is measured."""
COVERED = 0.1
"""Fraction of the path between the last frames of the full model."""
STALE = 0.25
"""Change of a log E above which a frame of the full model is solved again at the end."""


@dataclass
class _Correction:
    """Full model minus reduced model at one frame; rows of points, then of the force."""

    frame: OnlineFrame
    centre: np.ndarray
    rows: np.ndarray
    slopes: np.ndarray

    def at(self, log_young: np.ndarray) -> np.ndarray:
        return self.rows + self.slopes @ (log_young - self.centre)


class Corrections:
    """Corrections measured at frames of the full model and interpolated between them; ``sigmas``
    [r] are the standard deviations of a frame's measurements."""

    def __init__(self, sigmas: np.ndarray):
        self._sigmas = sigmas
        self._known: list[_Correction] = []
        self._surprises: list[float] = []

    @property
    def error(self) -> float:
        """Error of the model over the noise of a measurement, from the last full frames."""
        return float(np.sqrt(np.mean(np.square(self._surprises[-3:])))
                     ) if self._surprises else UNCHECKED_ERROR

    @property
    def is_checked(self) -> bool:
        """Whether the error of the reduced model is known."""
        return len(self._surprises) >= 3

    def forget(self) -> None:
        """Discard them, because they belong to another basis."""
        self._known.clear()

    def at(self, frame: OnlineFrame, log_young: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rows [r] and slopes [r, K] to add at a frame: from the two nearest known frames."""
        count = len(self._sigmas)
        if not self._known:
            return np.zeros(count), np.zeros((count, len(log_young)))
        far = np.array([np.linalg.norm(known.frame.pose[:3] - frame.pose[:3])
                        for known in self._known])
        near = np.argsort(far)[:2]
        share = 1 / np.maximum(far[near], 1e-9)
        share /= share.sum()
        chosen = [self._known[index] for index in near]
        return (sum(part * known.at(log_young) for part, known in zip(share, chosen, strict=True)),
                sum(part * known.slopes for part, known in zip(share, chosen, strict=True)))

    def add(self, frame: OnlineFrame, found: ExactFrame, rows: np.ndarray,
            slopes: np.ndarray) -> None:
        """Add a frame of the full model, with the reduced model's rows and slopes for it."""
        exact = np.r_[found.moved.ravel(), found.force]
        d_exact = np.vstack([found.d_moved.reshape(-1, found.d_moved.shape[-1]), found.d_force])
        new = _Correction(frame, found.log_young, exact - rows, d_exact - slopes)
        predicted = self.at(frame, found.log_young)[0]
        self._surprises.append(float(np.sqrt(np.mean(((new.rows - predicted) / self._sigmas)**2))))
        self._known = [old for old in self._known if old.frame is not frame]
        self._known.append(new)

    def next_requested(self, kept: list[Kept], log_young: np.ndarray) -> Kept | None:
        """Return the frame farthest from the known ones. None: none is far."""
        poses = np.array([each.frame.pose[:3] for each in kept])
        far = np.full(len(poses), np.inf)
        for known in self._known:
            near = np.linalg.norm(poses - known.frame.pose[:3], axis=1)
            if np.abs(known.centre - log_young).max() < STALE:
                far = np.minimum(far, near)
        far[[each.state is None for each in kept]] = -1.0
        index = int(np.argmax(far))
        if far[index] < 0 or far[index] < COVERED * np.linalg.norm(np.ptp(poses, axis=0)):
            return None
        return kept[index]


STEP_LIMIT = 0.7
"""Largest change of a log E by one frame."""
BUDGET_SECONDS = 0.028
"""An old frame is linearised again only if that fits into a frame's 33 ms, which end with the
intervals.
"""
ENOUGH_DEVIATION = 0.02
"""Standard deviation of every log E below which another pull is not worthwhile: half a percent of
the radius has the same effect.
"""
QUICK = reduced_model.ReducedStaticSettings(start_count=2, max_halvings=2)
"""A pose that takes more is outside the basis' range, and another basis is being made."""
FRAME_ITERATIONS, NEAR_ITERATIONS = 12, 6
"""Newton iterations while frames arrive: most for a frame; fewest for a frame with a known state,
at slightly different moduli. Both usually take 4; searches for a state that the training knows
better took up to 41, longer than a frame.
"""
FINAL_FRAMES = 300
"""Most frames that are linearised again after the pull."""
IDLE_DEVIATION = 0.3
"""Deviation of every log E above which no pull is called idle: a pull begins slowly."""
IDLE_GAIN = 0.01
"""Narrowing of an interval by the last tenth of the frames, below which the pull is idle."""


@dataclass(frozen=True)
class OnlineState:
    """The estimate after a frame: moduli [K] [Pa], 95 % interval [K, 2], and RMS of the
    standardised residuals before the update (NaN: frame not used). ``trusted``: the reduced model
    covers it; ``enough``: another pull is not worthwhile; ``idle``: this one adds nothing more."""

    time: float
    young: np.ndarray
    interval: np.ndarray
    residual: float
    trusted: bool
    enough: bool
    idle: bool


class OnlineEstimator:
    """Takes frames one by one.

    Args:
        reduced: Reduced model of the branch held at the recorded grasp; the moduli around which it
            was made are the start.
        entry: The recorded grasp.
        mesh: The mesh of the reduced model.
        rest_points: Observed points at rest [m], shape [m, 3].
        position_sigma: Noise of points [m].
        force_sigma: Noise of the force [N].
        prior_deviation: Standard deviation of log E at the start.
        kept_count: Number of frames that are linearised repeatedly.
        exact: The full model; None: the reduced model is not corrected.
    """

    def __init__(self, reduced: reduced_model.ReducedModel, entry: GraspEntry, mesh: TetMesh,
                 rest_points: np.ndarray, *, position_sigma: float, force_sigma: float,
                 prior_deviation: float = 2.0, kept_count: int = 64,
                 exact: Beside | None = None):
        self._entry, self._mesh = entry, mesh
        self.rest_points = np.asarray(rest_points, float)
        self._use(reduced)
        self._sigmas = np.r_[np.full(self.rest_points.size, position_sigma),
                             np.full(3, force_sigma)]
        self.log_young = np.log(reduced.control_young)
        self._information = Information(self.log_young, prior_deviation, kept_count)
        self._widths: list[np.ndarray] = []
        self._turn = self.frame_count = self.refresh_count = 0
        self._last: reduced_model.ReducedState | None = None
        # Loading compiled code at the first call must not delay the first frame.
        reduced.sensitivities(reduced.solve_static(reduced.poses[0], settings=QUICK))
        self._exact = exact
        self._corrections = Corrections(self._sigmas)
        self._asked: tuple[Kept, Future] | None = None
        self._making: Future | None = None
        self._lost: list[OnlineFrame] = []
        self._retry: list[OnlineFrame] = []
        self._untrusted = self._since_basis = 0

    def _use(self, reduced: reduced_model.ReducedModel) -> None:
        self.reduced = reduced
        columns = reduced.basis.columns.reshape(reduced.size, -1)
        self._observe = np.asarray(point_operator(self._mesh, self.rest_points) @ columns.T)

    @property
    def model_error(self) -> float:
        """Error of the model over the noise of a measurement, from the last full frames."""
        return 0.0 if self._exact is None else self._corrections.error

    @property
    def covariance(self) -> np.ndarray:
        """Covariance of log E, shape [K, K], of the noise and the model's common error."""
        widened = 1 + self.frame_count * self.model_error**2
        return widened * np.linalg.inv(self._information.normal_gradient(self.log_young)[0])

    @property
    def young(self) -> np.ndarray:
        """[Pa], shape [K]."""
        return np.exp(self.log_young)

    def update(self, frame: OnlineFrame) -> OnlineState:
        """Process a frame; one reduced solution, and a second if time allows."""
        began = time.perf_counter()
        self._collect()
        own_began = time.perf_counter()
        kept = self._linearised(frame, self._last, _within(FRAME_ITERATIONS))
        own = time.perf_counter() - own_began
        self.frame_count += 1
        self._since_basis += 1
        if kept is None:
            # Outside the basis' range: a new basis may cover it.
            self._lost.append(frame)
            if self._information.kept:
                self._ask()
            return self._state(frame.time, np.nan, False)
        state = present(kept.state, "state of the frame")
        self._untrusted += not state.trusted
        self._last = state
        self._information.add(kept)
        self._step()
        self._ask()
        # A second one takes as long as the one for this frame, except for the iterations.
        left = BUDGET_SECONDS - (time.perf_counter() - began) - (own - state.seconds)
        fitting = int(min(left / state.seconds * state.iterations, FRAME_ITERATIONS))
        if self._retry and fitting >= 2 * NEAR_ITERATIONS:
            self._try_again(_within(fitting))
        elif len(self._information.kept) > 1 and fitting >= NEAR_ITERATIONS:
            self._relinearise(_within(fitting))
            self._step()
        return self._state(frame.time, kept.residual, state.trusted)

    def settle(self) -> OnlineState | None:
        """Wait for the full model, linearise all frames again; None before any frame."""
        if not self._information.kept:
            return None
        if self._exact is not None:
            self._await()
            while self._retry:
                self._try_again(QUICK)
            # First a basis that covers these moduli and poses, then its corrections.
            for _ in range(2):
                if not (self._is_away() or self._lost or self._untrusted):
                    break
                self._making = self._exact.basis(self._spread_poses(), self.log_young.copy())
                self._await()
                while self._retry:
                    self._try_again(QUICK)
            for _ in range(3 * int(1 / COVERED)):
                if not self._ask(whole=True):
                    break
                self._await()
        self._linearise_all()
        last = self._information.kept[-1]
        return self._state(last.frame.time, last.residual,
                           present(last.state, "state of the last frame").trusted)

    def _try_again(self, settings: reduced_model.ReducedStaticSettings) -> None:
        """Process a frame that the previous basis did not cover."""
        frame = self._retry.pop(0)
        found = self._linearised(frame, None, settings)
        if found is None:
            self._lost.append(frame)
        else:
            self._information.add(found)
            self._step()

    def _linearise_all(self) -> None:
        """Replace merged information by the stored frames, linearised at the current moduli."""
        states = {id(kept.frame): kept.state for kept in self._information.kept}
        known = self._information
        frames = sorted([*(kept.frame for kept in known.kept), *known.past, *self._lost],
                        key=lambda frame: frame.time)
        chosen = np.unique(np.linspace(0, len(frames) - 1, FINAL_FRAMES).round().astype(int))
        weight = len(frames) / len(chosen)
        kept: list[Kept] = []
        for _ in range(6):
            before, kept, state = self.log_young.copy(), [], None
            for index in chosen:
                frame = frames[index]
                found = self._linearised(frame, states.get(id(frame)) or state, QUICK)
                if found is not None:
                    state = states[id(frame)] = found.state
                    kept.append(replace(found, normal=weight * found.normal,
                                        gradient=weight * found.gradient))
            self._information.replace(kept)
            self._step()
            if np.abs(self.log_young - before).max() < 1e-3:
                break

    def _is_strange(self) -> bool:
        """Whether the pull has left the range of the basis, and another one is worthwhile."""
        if self._since_basis < 10:
            return False
        return (self._is_away() or len(self._lost) > 2
                or self._untrusted > 0.3 * self._since_basis)

    def _is_away(self) -> bool:
        away = np.abs(self.log_young - np.log(self.reduced.control_young)).max()
        return bool(away > np.log(1.05 * self.reduced.young_spread))

    def _await(self) -> None:
        for future in (self._asked[1] if self._asked else None, self._making):
            if future is not None:
                future.exception()
        self._collect()

    def _collect(self) -> None:
        """Process the results of the full model so far."""
        if self._making is not None and self._making.done():
            making, self._making = self._making, None
            if making.exception() is None:
                self._use(making.result())
                self.refresh_count += 1
                self._corrections.forget()
                self._last, self._untrusted, self._since_basis = None, 0, 0
                # The information stays valid; its coordinates belong to the old basis.
                for old in self._information.kept:
                    old.state = None
                self._retry, self._lost = self._retry + self._lost, []
        if self._asked is None or not self._asked[1].done():
            return
        (kept, future), self._asked = self._asked, None
        found = None if future.exception() is not None else future.result()
        if found is None:
            return
        # Compared at the moduli of the full model's solve.
        reduced = self._answer(kept.frame, kept.state, found.log_young, _within(FRAME_ITERATIONS))
        if reduced is None:
            return
        self._corrections.add(kept.frame, found, *reduced[1:])

    def _ask(self, whole: bool = False) -> bool:
        """Solve the stored frame that is farthest from the solved ones; return whether there was
        one."""
        if self._exact is None or self._asked is not None or self._making is not None:
            return False
        if not whole and self._is_strange():
            self._making = self._exact.basis(self._spread_poses(), self.log_young.copy())
            return True
        chosen = self._corrections.next_requested(self._information.kept, self.log_young)
        if chosen is None:
            return False
        start = self.reduced.displacement(present(chosen.state, "state of the frame"))
        self._asked = chosen, self._exact.frame(chosen.frame.pose, self.log_young.copy(), start)
        return True

    def _spread_poses(self) -> np.ndarray:
        """Poses spread over all those seen, including the lost ones."""
        frames = sorted([*(kept.frame for kept in self._information.kept), *self._lost],
                        key=lambda frame: frame.time)
        chosen = np.unique(np.linspace(0, len(frames) - 1, 24).round().astype(int))
        return np.array([frames[index].pose for index in chosen])

    def _answer(self, frame: OnlineFrame, start: reduced_model.ReducedState | None,
                log_young: np.ndarray, settings: reduced_model.ReducedStaticSettings,
                ) -> tuple[reduced_model.ReducedState, np.ndarray, np.ndarray] | None:
        """The reduced model's state, rows of points and force, and their derivatives."""
        model = self.reduced.with_young(np.exp(log_young))
        state = model.solve_static(pose_on(self.reduced.grasp, self._entry, frame.pose),
                                   start=start, settings=settings)
        if not state.converged:
            return None
        slopes = model.sensitivities(state)
        return (state, np.r_[self._observe @ state.coordinates, state.reaction_force],
                np.vstack([self._observe @ slopes.coordinates, slopes.reaction_force]))

    def _linearised(self, frame: OnlineFrame, start: reduced_model.ReducedState | None,
                    settings: reduced_model.ReducedStaticSettings) -> Kept | None:
        found = self._answer(frame, start, self.log_young, settings)
        if found is None:
            return None
        state, rows, slopes = found
        more, steeper = self._corrections.at(frame, self.log_young)
        measured = np.r_[(frame.positions - self.rest_points).ravel(), frame.force]
        seen = np.isfinite(measured)
        off = ((rows + more - measured) / self._sigmas)[seen]
        jacobian = ((slopes + steeper) / self._sigmas[:, None])[seen]
        # A robust fraction: beyond 4 deviations a residual counts less, once the fit is near.
        typical = max(1.0, 1.4826 * float(np.median(np.abs(off))) if len(off) else 1.0)
        weight = 1.0 / np.maximum(np.abs(off) / (4.0 * typical), 1.0)
        scaled = jacobian.T * weight
        return Kept(frame, state, self.log_young.copy(), scaled @ jacobian, scaled @ off,
                    float(np.sqrt(np.mean(off**2))) if len(off) else 0.0)

    def _relinearise(self, settings: reduced_model.ReducedStaticSettings) -> None:
        self._turn = (self._turn + 1) % (len(self._information.kept) - 1)
        old = self._information.kept[self._turn]
        again = self._linearised(old.frame, old.state, settings)
        if again is not None:
            self._information.kept[self._turn] = again

    def _step(self) -> None:
        normal, gradient = self._information.normal_gradient(self.log_young)
        step = -np.linalg.solve(normal, gradient)
        step *= min(1.0, STEP_LIMIT / max(np.abs(step).max(), 1e-12))
        self.log_young = np.clip(self.log_young + step, *np.log(YOUNG_BOUNDS_PA))

    def _state(self, time: float, residual: float, trusted: bool) -> OnlineState:
        deviation = np.sqrt(np.diag(self.covariance))
        width = scipy.special.ndtri(0.975) * deviation
        interval = np.exp(self.log_young[:, None] + np.column_stack([-width, width]))
        # The error of the reduced model is unknown before the first frames of the full one.
        checked = self._exact is None or self._corrections.is_checked
        enough = bool(checked and deviation.max() < ENOUGH_DEVIATION)
        return OnlineState(time, self.young, interval, residual, trusted, enough, self._idle())

    def _idle(self) -> bool:
        """From the noise alone: occasional results of the full model are not due to a frame."""
        widths = self._widths
        widths.append(np.sqrt(np.diag(np.linalg.inv(self._information.normal_gradient(self.log_young)[0]))))
        unknown = self._lost or self._retry or self._is_strange()
        if len(widths) < 30 or (self._exact is not None and unknown):
            return False
        return bool(np.max(1 - widths[-1] / widths[-1 - len(widths) // 10]) < IDLE_GAIN
                    and widths[-1].max() < IDLE_DEVIATION)


def _within(iterations: int) -> reduced_model.ReducedStaticSettings:
    return replace(QUICK, iteration_limit=iterations)
