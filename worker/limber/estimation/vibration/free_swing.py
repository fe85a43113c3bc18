"""Young's modulus and damping from the free swing of a released branch, without a robot.

The branch is held in its shape at rest until its weight and an added load act all at once, or a
load bends it until the load is removed. The motion is simulated from there and fitted to the marker
tracks. Free are one factor on Young's modulus, the time of release, Rayleigh's two parameters, a
gain of each marker's motion for the error of its position on the branch (known from the
registration), and the branch's density within its prior. Both frequency and displacement determine
the modulus. The fit is by the branch's modes, and the full model corrects it for the last digits.
Where the tracks show it, the branch creeps as a standard linear solid.

Errors of the model persist through many frames. The number of independent readings therefore
follows from the autocorrelation of the residual, and the intervals are based on the residual, not
on the camera's noise.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy
from scipy import sparse

from limber.core.errors import InputError, Option, WorkError
from limber.core.not_none import present
from limber.core.progress import SILENT, Progress
from limber.estimation.uncertainty.creep import LIKELIER, TIME_SHARES, creep_sentence
from limber.estimation.uncertainty.model_error import MeshStiffness, mesh_error
from limber.estimation.vibration.ringing import repetition
from limber.mechanics.added_masses import PointMass
from limber.mechanics.dynamics.integration import simulate_dynamics
from limber.mechanics.dynamics.motion import NewmarkSettings, lowest_modes
from limber.mechanics.grasp import Grasp
from limber.mechanics.materials.materials import RayleighDamping
from limber.mechanics.model import BranchModel
from limber.mechanics.points import point_operator
from limber.recordings.hung_load import REGISTRATION_SHARE

# A swing by the lowest modes of the branch: a millisecond for what the full model takes seconds.
#
# The branch vibrates about the equilibrium at the end, from the shape in which it was released.
# Both are columns of the basis beside the modes, so that beginning and end are exact for small
# factors on modulus and density, and the vibration between them is that of the linear branch. A fit
# by modes is corrected by the full model's difference at its result, which changes little with the
# parameters.

MODES = 10
"""Modes of a swing: six more than what 40 steps a period show."""
STEP = 1e-4
"""Step of the central differences in the logarithms."""
_DENSITY_STEP = 1e-2
_SAME = 1e-6  # norm of a column that the others already contain


@dataclass(frozen=True)
class Ends:
    """Displacements [n, 3] [m] at release (zero: held in the rest shape) and where the swing
    ends."""

    begin: np.ndarray
    end: np.ndarray


class ModalSwing:
    """Markers' displacements in small vibrations. ``denser`` is the same with 1 % more density,
    ``operator`` [3 m, 3 n] from nodes to markers."""

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
        """Return markers' displacements [f, m, 3] [m] since release; ``stretch`` and ``heavier``
        are logs of factors on modulus and density, ``creep`` a relaxing share and time [s]."""
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
        creep also to its share, [f, m, 3, 5]."""
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
    """Return oscillators that start at 1 without speed, overdamped too, at times [f, 1] [s] with
    undamped squares [k] [1/s^2] and decay rates."""
    root = np.sqrt((decay**2 - squares).astype(complex))
    # At the limit of overdamping both roots are equal, and the motion is the same beside it.
    root = np.where(np.abs(root) < 1e-6 * np.sqrt(squares), 1e-6 * np.sqrt(squares), root)
    fast = -(decay + root)
    slow = squares / fast
    return ((slow * np.exp(fast * times) - fast * np.exp(slow * times)) / (slow - fast)).real


def _creeping(times: np.ndarray, squares: np.ndarray, decay: np.ndarray, share: float,
              seconds: float) -> np.ndarray:
    """Return such oscillators of standard linear solids, shape [f, k]: part of the spring force
    follows the motion late, y'' + 2 d y' + w^2 (y - share z) = 0 with z' = (y - z) / seconds."""
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


# A recorded swing, the result of its fit, and a first guess of frequency and damping.

_GONE = 0.3
"""Fraction of its path at which a branch has certainly been released."""


@dataclass(frozen=True)
class SwingSeen:
    """A swing's markers [n, m, 3] [m] from rest (NaN: not observed). ``start`` is "held" in the
    rest shape until weight and load act, or "loaded" until the load goes. ``load_mass`` [kg] swings
    too (0: a pull, or removed). ``registration`` [m] is the markers' RMS from stated positions."""

    times: np.ndarray
    moved: np.ndarray
    rest_points: np.ndarray
    start: str
    load: np.ndarray
    load_mass: float
    noise: float
    registration: float | None = None


@dataclass(frozen=True)
class SwingFit:
    """Result of a swing; intervals are 95 % intervals, ``damping_interval`` [2, 2].

    Attributes:
        factor: Factor on the start's Young's modulus, corrected for the mesh's stiffness.
        mesh_factor: The correction; 1 if a finer mesh was not possible.
        release: [s] on the recording's clock.
        damping: Rayleigh's alpha [1/s] and beta [s]; ``damping_ratio`` is of the first vibration.
        frequency: Frequency of the first vibration about the equilibrium [Hz].
        residual: RMS of observed minus simulated [m]; over the largest displacement it is
            ``relative_residual``.
        readings: Number of independent readings, from the residual's autocorrelation.
        window: First and last time used [s].
        creep: ``share``, its ``interval`` and ``time_s`` as for a pull; None: the record does not
            show any.
    """

    factor: float
    factor_interval: np.ndarray
    mesh_factor: float
    release: float
    release_deviation: float
    damping: tuple[float, float]
    damping_interval: np.ndarray
    damping_ratio: float
    damping_ratio_interval: np.ndarray
    frequency: float
    residual: float
    relative_residual: float
    readings: float
    forward_count: int
    window: tuple[float, float]
    times: np.ndarray
    seen: np.ndarray
    simulated: np.ndarray
    converged: bool
    creep: dict[str, Any] | None = None


def first_guess(seen: SwingSeen) -> tuple[float, float]:
    """Return a branch's time of release and its period [s], from the tracks alone. InputError if no
    motion is found, or the branch does not oscillate."""
    travel = np.linalg.norm(seen.moved - np.nanmedian(seen.moved[:3], axis=0), axis=2)
    # From the marker that moves farthest: others are disturbed while the branch is still held.
    far = travel[:, np.argmax(np.nan_to_num(travel).max(axis=0))]
    far = np.where(np.isfinite(far), far, 0.0)
    if far.max() < 10 * seen.noise:
        raise InputError("The recording shows no swing.",
                         f"No marker moves by more than {1e3 * far.max():.2g} mm.",
                         "Start the recording before the branch is released.")
    gone = int(np.argmax(far > _GONE * far.max()))
    at_rest = np.flatnonzero(far[:gone] < max(6 * seen.noise, 0.02 * far.max()))
    start = int(at_rest[-1]) + 1 if len(at_rest) else 0
    marker, axis = np.unravel_index(np.nanargmax(np.nanvar(seen.moved[start:], axis=0)),
                                    seen.moved.shape[1:])
    track = seen.moved[start:, marker, axis]
    times = seen.times[start:][np.isfinite(track)]
    track = track[np.isfinite(track)]
    settled = np.median(track[-max(len(track) // 4, 5):])
    away = track - settled
    large = np.flatnonzero(np.abs(away) > 0.05 * np.abs(away).max())
    away, times = away[:large[-1] + 1], times[:large[-1] + 1]
    turns = np.flatnonzero((away[:-1] < 0) != (away[1:] < 0))
    if len(turns) < 3:
        raise InputError("The branch does not oscillate.", "It passes its rest position only "
                         f"{len(turns)} times.", "Release it abruptly, or fit the rest position: ",
                         Option("motion", "quasi_static"), ".")
    cross = times[turns] - away[turns] * (times[turns + 1] - times[turns]) / (
        away[turns + 1] - away[turns])
    # Over whole periods: the equilibrium may be slightly offset, as for a branch that creeps.
    period = float(np.median(cross[2:] - cross[:-2]))
    rate = float(np.median(np.diff(seen.times)))
    if period < 6 * rate:
        raise InputError(f"The branch swings {1 / period:.3g} times a second.",
                         f"This is too fast for {1 / rate:.3g} frames a second.",
                         "Record with more frames a second.")
    return float(seen.times[max(start - 1, 0)]), period


STEPS_PER_PERIOD = 40
"""Steps per period of the first vibration; the error in its frequency is then 0.2 %."""
_FIRST_PERIODS = 1.5
"""Periods at the start of the fit: simulation and observation cannot differ by a period."""
_DAMPING_BOUNDS = (1e-4, 1e3)
"""Bounds of Rayleigh's alpha over the first angular frequency, and of beta times it."""
_FULL_RUNS = 4
"""Most simulations by the full model."""
_SETTLED = 0.5
"""Change of the motion by a correction, in standard deviations, after which there is no other. The
modulus of virtual beams then changed by 0.03 %, a fiftieth of its deviation.
"""
_ROUNDS = 200
"""Most evaluations of a fit: of two damping parameters one vibration determines the sum only."""
_SHARE_BOUNDS = (-0.5, 0.9)
"""Bounds of the share by which creep lowers the modulus; a negative one is not creep."""
_MARGIN = 0.1
"""Deviation of a marker's gain if the registration is not known."""


def fit_swing(model: BranchModel, grasp: Grasp, seen: SwingSeen, *, periods: float = 6.0,
              density_sigma: float = 0.1, progress: Progress = SILENT) -> SwingFit:
    """Fit modulus and damping to a swing; the moduli's ratios stay, the density has a relative
    deviation. InputError if the recording shows no swing, WorkError if the simulation fails."""
    swing = _Swing(model, grasp, seen, density_sigma)
    released, period = first_guess(seen)
    swing.scale_to(period, released)
    found = None
    progress(0.0, "fitting the swing by the branch's modes")
    swing.use_modes()
    for share in (_FIRST_PERIODS, periods, periods):
        # The last one with priors weighted against the actual residual of the model.
        found = swing.fitted(released, share * period, found)
    found = present(found, "fit by modes")
    for number in range(_FULL_RUNS):
        progress((1 + number) / (1 + _FULL_RUNS), "correcting it by the full model")
        swing.correct(found)
        if number == 0:
            # Large deflections, which modes do not have, must not pass for creep.
            found = swing.with_creep(released, swing.fitted(released, periods * period, found))
        before, found = found, swing.fitted(released, periods * period, found)
        if swing.is_settled(before, found):
            break
    else:
        found = replace(found, converged=False)
    result = swing.judged(found)
    if result.creep is not None:
        progress.warn(creep_sentence(result.creep))
    return result


class _Swing:
    """The model fitted to the tracks; free: log factor, release, log alpha/w, log beta w, log
    density, and each marker's gain."""

    def __init__(self, model: BranchModel, grasp: Grasp, seen: SwingSeen, density_sigma: float):
        share = np.maximum(grasp.weights, 0.0) / np.maximum(grasp.weights, 0.0).sum()
        if seen.load_mass and seen.start == "held":
            model = model.with_point_masses(
                PointMass(tuple(model.mesh.nodes[node]), float(seen.load_mass * part))
                for node, part in zip(grasp.nodes, share, strict=True) if part > 0)
        self.model, self.grasp, self.seen = model, grasp, seen
        # A hung mass acts by its own weight.
        self.load = np.zeros(3) if seen.start == "held" and seen.load_mass else seen.load
        self.operator = point_operator(model.mesh, seen.rest_points)
        size = float(np.nanmax(np.linalg.norm(seen.moved, axis=2)))
        self.gain_sigma = (_MARGIN if seen.registration is None
                           else REGISTRATION_SHARE * seen.registration / size + 1e-3)
        self.density_sigma = max(density_sigma, 1e-6)
        self.forward_count, self.factor0 = 0, 1.0
        self._modes: ModalSwing | None = None
        self._correction: np.ndarray | None = None
        self.creep_time: float | None = None

    def scale_to(self, period: float, released: float) -> None:
        """Estimate the modulus from the period, and damping from the decay of the swing."""
        frequency = self.frequency(self.model)
        self.factor0 = (1 / period / frequency) ** 2
        self.omega, self.period = 2 * np.pi / period, period
        after = self.seen.times > released
        travel = np.nan_to_num(np.linalg.norm(
            self.seen.moved[after] - np.nanmean(self.seen.moved[-5:], axis=0), axis=2)).max(axis=1)
        times = self.seen.times[after]
        half = max(round(period / 2 / np.median(np.diff(times))), 1)
        peaks = [travel[k:k + half].max() for k in range(0, len(travel) - half, half)][:6]
        fall = np.polyfit(np.arange(len(peaks)), np.log(np.maximum(peaks, 1e-9)), 1)[0]
        self.ratio0 = float(np.clip(-fall / np.pi, 2e-3, 0.3))

    @property
    def ramp(self) -> float:
        """Middle of the step in which the load is removed [s]."""
        return 0.5 * self.period / STEPS_PER_PERIOD if self.seen.start == "loaded" else 0.0

    def mesh_stiffness(self, model: BranchModel) -> MeshStiffness:
        """Return the excess stiffness of the mesh; 1 if a finer mesh would be too large."""
        level = float(model.young.mean())
        found = mesh_error(model.without_point_masses(), self.grasp, self.operator,
                           (model.young / level)[:, None], np.array([level]))
        return found or MeshStiffness(np.ones(1), np.zeros(1))

    def frequency(self, model: BranchModel) -> float:
        """Return the first frequency about the equilibrium [Hz]."""
        rest = self._ends(model).end
        tangent, mode = model.equations().tangent(model, rest), np.random.default_rng(0).normal(
            size=rest.shape)
        for _ in range(25):
            mode = tangent.solve(model.mass_times(mode))
            mode /= np.linalg.norm(mode)
        stiffness = float((mode * model.tangent_times(rest, mode)).sum())
        return float(np.sqrt(stiffness / (mode * model.mass_times(mode)).sum()) / (2 * np.pi))

    def use_modes(self) -> None:
        """Simulate small vibrations about the equilibrium from now on."""
        model = self.model.with_parameters(young=self.model.young * self.factor0)
        denser = ModalSwing.denser(model)
        self._modes = ModalSwing(model, self._ends(model), self._ends(denser), self.operator)

    def _ends(self, model: BranchModel) -> Ends:
        from limber.mechanics.statics.solve import solve_static

        def loaded() -> np.ndarray:
            return solve_static(model, grasp=self.grasp, grasp_force=self.load
                                ).require().displacement

        is_loaded = self.seen.start == "loaded"
        free = not self.load.any() or is_loaded
        end = solve_static(model).require().displacement if free else loaded()
        return Ends(loaded() if is_loaded else np.zeros_like(end), end)

    def correct(self, found: "_Found") -> None:
        """Add the full model's difference from the modes at a result."""
        duration = found.duration + self.period
        self._correction, creep_time, self.creep_time = None, self.creep_time, None
        # The full model does not creep.
        times, moved, _ = self.simulated(found.free, duration)
        self._correction, self.creep_time = self._full(found.free, times) - moved, creep_time

    def with_creep(self, released: float, found: "_Found") -> "_Found":
        """Return a fit with creep if it is more likely, by the evidence of a parameter and its time
        constant (Schwarz 1978) over independent readings; else the same fit."""
        best, best_time, likeliest = found, None, LIKELIER
        for share in TIME_SHARES:
            self.creep_time = share * found.duration
            creeping = self.fitted(released, found.duration,
                                   replace(found, free=np.r_[found.free, 0.0]), found.sigma)
            if not creeping.converged or creeping.free[-1] <= 0:
                continue
            rms, stretch, _ = self.left_over(creeping)
            readings = creeping.known.sum() / stretch
            self.creep_time = None
            likelier = readings * np.log(self.left_over(found)[0] / rms) - 0.5 * np.log(
                readings) - np.log(len(TIME_SHARES))
            if likelier > likeliest:
                best, best_time, likeliest = creeping, share * found.duration, likelier
        self.creep_time = best_time
        return best

    def is_settled(self, before: "_Found", found: "_Found") -> bool:
        """Whether a correction has changed the motion by less than matters."""
        now, then = (self.rows(each.free, found.chosen, found.duration + self.period)[0]
                     for each in (found, before))
        change = (now - then)[found.known] / self.left_over(found)[2]
        return float(np.linalg.norm(change)) < _SETTLED

    def with_values(self, free: np.ndarray) -> BranchModel:
        damping = RayleighDamping(float(np.exp(free[2]) * self.omega),
                                  float(np.exp(free[3]) / self.omega))
        return self.model.with_parameters(
            young=self.model.young * self.factor0 * np.exp(free[0]), damping=damping,
            density=self.model.density * np.exp(free[4]))

    def simulated(self, free: np.ndarray, duration: float) -> tuple[np.ndarray, ...]:
        """Return times since release [f], markers [f, m, 3], and slopes [f, m, 3, 4 or 5] to log
        factor, alpha, beta, density, and creep's share."""
        step = self.period / STEPS_PER_PERIOD
        times = step * np.arange(int(np.ceil(duration / step)) + 2)
        damping = self.with_values(free).damping
        modes = present(self._modes, "modes of the branch")
        values = (np.maximum(times - self.ramp, 0.0), free[0],
                  (damping.mass, damping.stiffness), free[4])
        creep = () if self.creep_time is None else ((float(free[-1]), self.creep_time),)
        moved = modes.moved(*values, *creep)
        if self._correction is not None:
            moved[:len(self._correction)] += self._correction[:len(moved)]
        return times, moved, modes.slopes(*values, *creep)

    def _full(self, free: np.ndarray, times: np.ndarray) -> np.ndarray:
        """Return displacements of the markers by the full model [m], shape [f, m, 3]."""
        model, step = self.with_values(free), self.period / STEPS_PER_PERIOD
        grasp: Grasp | None = None
        forces: np.ndarray | None = None
        if self.load.any():
            forces = np.tile(self.load, (len(times), 1))
            if self.seen.start == "loaded":
                forces[1:] = 0.0
            grasp = self.grasp
        result = simulate_dynamics(
            model, grasp=grasp, grasp_forces=forces, times=times,
            start="equilibrium" if self.seen.start == "loaded" else "rest",
            settings=NewmarkSettings(max_step=step))
        self.forward_count += 1
        if not result.converged:
            raise WorkError(f"The simulation of the swing failed: {result.message}.",
                            "The load, mass or modulus does not suit the branch.",
                            "Check ", Option("weight"), ", the units and the density.")
        count = len(times)
        return (self.operator @ result.displacement.reshape(count, -1).T).T.reshape(count, -1, 3)

    def rows(self, free: np.ndarray, chosen: np.ndarray, duration: float,
             ) -> tuple[np.ndarray, np.ndarray]:
        """Return simulated displacements at the chosen frames, and derivatives to all free."""
        from scipy.interpolate import CubicSpline

        times, moved, slopes = self.simulated(free, duration)
        at = self.seen.times[chosen] - free[1]
        since = np.clip(at, 0.0, times[-1])
        track = CubicSpline(times, moved, axis=0)
        markers = self.seen.moved.shape[1]
        gain = 1 + free[5:5 + markers, None]
        model = gain * track(since)
        d = np.zeros((*model.shape, len(free)))
        by_values = [0, 2, 3, 4, *range(5 + markers, len(free))]
        d[..., by_values] = gain[..., None] * CubicSpline(times, slopes, axis=0)(since)
        d[..., 1] = -gain * track(since, 1) * ((at > 0) & (at < times[-1]))[:, None, None]
        for marker in range(markers):
            d[:, marker, :, 5 + marker] = track(since)[:, marker]
        return model, d

    def fitted(self, released: float, duration: float, start: "_Found | None",
               sigma: float | None = None) -> "_Found":
        from scipy.optimize import least_squares

        seen = self.seen
        chosen = np.flatnonzero((seen.times >= released - 2 * self.period / STEPS_PER_PERIOD)
                                & (seen.times <= released + duration))
        markers = seen.moved.shape[1]
        count = 5 + markers + (self.creep_time is not None)
        free = np.zeros(count) if start is None else start.free
        if start is None:
            free[1], free[2:4] = released, np.log(self.ratio0)
        known = np.isfinite(seen.moved[chosen])
        if start is None:
            sigma = max(seen.noise, 1e-3 * float(np.nanmax(np.abs(seen.moved))))
        elif sigma is None:
            sigma = self.left_over(start)[2]
        priors = np.r_[np.inf, np.inf, np.inf, np.inf, self.density_sigma,
                       np.full(markers, self.gain_sigma), np.full(count - 5 - markers, np.inf)]

        def residual(x: np.ndarray) -> np.ndarray:
            model, _ = self.rows(x, chosen, duration + self.period)
            return np.r_[(model - seen.moved[chosen])[known] / sigma, x[4:] / priors[4:]]

        def jacobian(x: np.ndarray) -> np.ndarray:
            _, slopes = self.rows(x, chosen, duration + self.period)
            return np.vstack([slopes[known] / sigma, np.diag(1 / priors)[4:]])

        low, high = np.full(count, -np.inf), np.full(count, np.inf)
        low[2:4], high[2:4] = np.log(_DAMPING_BOUNDS[0]), np.log(_DAMPING_BOUNDS[1])
        low[1], high[1] = released - 0.5 * self.period, released + 0.5 * self.period
        low[5 + markers:], high[5 + markers:] = _SHARE_BOUNDS
        scale = np.r_[0.1, 0.02 * self.period, 1.0, 1.0, 0.1, np.full(count - 5, 0.05)]
        found = least_squares(residual, np.clip(free, low + 1e-9, high - 1e-9), jacobian,
                              bounds=(low, high), x_scale=scale, xtol=1e-5, ftol=1e-6, gtol=1e-8,
                              loss="linear", max_nfev=_ROUNDS)
        return _Found(found.x, chosen, duration, found.success, known, sigma, priors)

    def left_over(self, found: "_Found") -> tuple[float, float, float]:
        """Return the residual's RMS [m], the number of readings that count as one, and the
        deviation [m] of each reading if they are to count as independent."""
        model, _ = self.rows(found.free, found.chosen, found.duration + self.period)
        left = np.where(found.known, model - self.seen.moved[found.chosen], np.nan)
        rms, stretch = float(np.sqrt(np.nanmean(left**2))), _correlated(left)
        return rms, stretch, max(rms, self.seen.noise) * float(np.sqrt(stretch))

    def judged(self, found: "_Found") -> SwingFit:
        """Return the fit with intervals that follow from the residuals."""
        seen, free = self.seen, found.free
        model, slopes = self.rows(free, found.chosen, found.duration + self.period)
        columns = slopes[found.known]
        rms, stretch, sigma = self.left_over(found)
        information = columns.T @ columns / sigma**2 + np.diag(1 / found.priors**2)
        # One vibration does not determine both alpha and beta: their intervals stay wide.
        information[[2, 3], [2, 3]] += 1 / np.log(_DAMPING_BOUNDS[1] / _DAMPING_BOUNDS[0]) ** 2
        cov = np.linalg.inv(information)
        wide = 1.96 * np.sqrt(np.diag(cov))
        best = self.with_values(free)
        frequency = self.frequency(best)
        omega = 2 * np.pi * frequency
        parts = np.array([best.damping.mass / (2 * omega), best.damping.stiffness * omega / 2])
        ratio = float(parts.sum())
        spread = 1.96 * float(np.sqrt(parts @ cov[2:4, 2:4] @ parts))
        ends, mesh = np.array([-1.0, 1.0]), self.mesh_stiffness(best)
        wide[0] = np.hypot(wide[0], 1.96 * mesh.deviation[0])
        factor = float(self.factor0 * np.exp(free[0]) * mesh.factor[0])
        values = np.array([best.damping.mass, best.damping.stiffness])
        return SwingFit(
            factor=factor, factor_interval=factor * np.exp(wide[0] * ends),
            mesh_factor=float(mesh.factor[0]), release=float(free[1] + self.ramp),
            release_deviation=float(wide[1] / 1.96),
            damping=(float(values[0]), float(values[1])),
            damping_interval=values[:, None] * np.exp(np.clip(wide[2:4], 0, 30)[:, None] * ends),
            damping_ratio=ratio, damping_ratio_interval=np.maximum(ratio + spread * ends, 0.0),
            frequency=frequency, residual=rms,
            relative_residual=rms / float(np.nanmax(np.abs(seen.moved))),
            readings=float(found.known.sum() / stretch), forward_count=self.forward_count,
            window=(float(seen.times[found.chosen[0]]), float(seen.times[found.chosen[-1]])),
            times=seen.times[found.chosen], seen=seen.moved[found.chosen], simulated=model,
            converged=bool(found.converged), creep=None if self.creep_time is None else {
                "share": float(free[-1]), "interval": (free[-1] + wide[-1] * ends).tolist(),
                "time_s": self.creep_time})


@dataclass(frozen=True)
class _Found:
    free: np.ndarray
    chosen: np.ndarray
    duration: float
    converged: bool
    known: np.ndarray
    sigma: float
    priors: np.ndarray


def _correlated(left: np.ndarray) -> float:
    """Return the number of readings that count as one: the sum of the residual's autocorrelation.
    Over time, and over markers and axes, which all follow the same motion."""
    flat = np.nan_to_num(left.reshape(len(left), -1))
    if not flat.any():
        return 1.0
    total = repetition(flat, len(flat) // 2)
    # Axes and markers that move together count as one: the participation of the principal ones.
    values = np.linalg.eigvalsh(flat.T @ flat)
    together = flat.shape[1] * float((values**2).sum()) / float(values.sum()) ** 2
    return total * max(together, 1.0)
