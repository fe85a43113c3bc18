"""Which cause explains the force on the gripper: a sequential test of named hypotheses.

"As predicted" means that the difference of measured and predicted force has errors of known sizes:
noise measured at rest, drift since the branch was held, gain, the plan's own covariance, weight
and inertia of the gripper, and errors of place, which the branch's stiffness makes a force: a base
that is turned, a branch that lies a little aside in the jaws, readings older than the pose. A
Kalman filter with these errors as its state makes the difference white. A hypothesis adds a signal
of known shape; the same filter whitens it, and the products of both give the ratio of likelihoods.
By Ville's inequality a ratio of N hypotheses together exceeds N / p during a motion, however long,
with a probability of at most p, so the threshold follows from the false alarms allowed and from no
force: it is the same for 0.3 N and 100 N.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from limber.core.constants import STANDARD_GRAVITY
from limber.geometry.rigid_kernels import frame_of, length
from limber.robot.motion.trajectory import LAID_M

if TYPE_CHECKING:
    from limber.cell.cell_file import Cell
    from limber.robot.motion.trajectory import Trajectory

FALSE_ALARMS = 1e-4
"""Probability of an alarm during a motion that goes as predicted."""
BLOCK_SECONDS = 0.02
"""Time over which forces are averaged: readings of the slowest sensors are then independent."""

_MOST_ONSETS, _APART_M, _APART_S = 24, 0.001, 0.06
_STATES = 17
# Of the state: the prediction's factor, gain, weight, inertia and places stay; the sensor's zero
# walks; what is not known of the force otherwise changes along the path.
_ZERO, _CHANGING = slice(4, 7), slice(7, 10)
_GAIN = 0.05  # of the sensor, and of the model beyond its stated error
_UNKNOWN = 0.03  # of the largest predicted force: shape of the branch, friction, swinging
_COLOURED = 0.3  # of the noise: the part that changes more slowly than blocks
_ALIKE_M, _ALIKE_S = 0.01, 5.0  # over which that stays alike
_CHANGES = 0.05  # of the variance of the prediction's factor; the rest is the same all along
_NOTHING_OFF = 8.0  # E is positive: no force at all is at least so many deviations off
_DRIFT_SECONDS = 2.0
_AGE_SECONDS = 0.02  # of a smoothed reading, against the pose
_ZERO_NOISE = 0.5  # of a block: the zero is a mean over more of them
_ALIKE_NATS, _MOST_NAMES = 3.0, 3  # hypotheses so near the best are named too
_MASS, _MASS_KG = 0.02, 0.01  # of a weighed gripper: a fraction, and at least
_DOWN = np.array([0.0, 0.0, -1.0])
_TURN_RAD = 0.7  # deviation of a turned sensor's angle
_STEP = 10.0  # deviations, of a force that nothing predicts
_CERTAINTY = 3.0  # standard deviations, of what is promised before the start

# Signals: the difference, from the start on, and those of each onset.
_SCALE, _LOAD, _TURNS, _DRIFTS, _FIXED = 1, 2, [3, 4, 5], (6, 7, 8), 9
_LOST, _SLIPS, _STEPS = 9, (10, 11, 12, 13), (14, 15, 16)
_SLIP_RATES = np.array([0.05, 0.4, 2.0, 8.0])
_PER_ONSET = 8
# Of the factor of a signal: mean and standard deviation.
_FROM_START: tuple[tuple[str, int, float, float], ...] = (
    ("nothing is held", _SCALE, -1.0, 0.03),
    ("the branch is softer than its moduli", _SCALE, -0.6, 0.15),
    ("the sensor reads a fraction of the force", _SCALE, -0.9, 0.03),
    ("the sensor's sign is wrong", _SCALE, -2.0, 0.1),
    ("the branch is stiffer than its moduli, or held elsewhere", _SCALE, 2.0, 0.7),
    ("the sensor reads a multiple of the force", _SCALE, 9.0, 3.0),
    ("the gripper carries another load than was weighed", _LOAD, 0.0, 0.5),
    *(("the sensor drifts", column, 0.0, 0.5) for column in _DRIFTS))
_SINCE: tuple[tuple[str, int, float, float], ...] = (
    ("the branch broke or came out of the gripper", _LOST, 1.0, 0.12),
    ("it slipped in the gripper or broke in part", _LOST, 0.5, 0.15),
    *(("it slips in the gripper", column, 1.0, 0.3) for column in _SLIPS),
    *(("something else pushes the gripper, or the sensor's zero has jumped", column, 0.0, _STEP)
      for column in _STEPS))
_ALARM = float(np.log((len(_FROM_START) + 1 + _MOST_ONSETS * len(_SINCE)) / FALSE_ALARMS))


@dataclass(frozen=True)
class ForceErrors:
    """Errors of a measured force that no branch causes: noise of a block at rest per axis [N], the
    sensor's drift [N/s], and the gripper's mass [kg], which weighs and is accelerated."""

    noise: float
    drift: float
    mass: float

    @classmethod
    def of_cell(cls, cell: "Cell", noise: float | None = None) -> "ForceErrors":
        """Return the errors that a cell states, with the noise measured at rest if it was."""
        return cls(noise or cell.sensor.force_sigma_n / (BLOCK_SECONDS * cell.arm.rate)**0.5,
                   cell.sensor.drift_n_per_minute / 60.0, cell.tool.mass_kg or 0.0)

    def measured(self, forces: np.ndarray | None, count: int) -> "ForceErrors":
        """Return them with the noise of forces at rest [N], shape [n, 3], in blocks of ``count``:
        repeated or smoothed readings are averaged less than white ones."""
        if forces is None:
            return self
        off = forces - forces.mean(axis=0)
        blocks = off[:len(off) // count * count].reshape(-1, count, 3).mean(axis=1)
        return replace(self, noise=max(1e-3, float(off.std() / np.sqrt(count)),
                                       float(blocks.std()) if len(blocks) else 0.0))


@dataclass(frozen=True)
class Block:
    """Means over a block: force change [N], measured minus predicted, ``predicted`` since the
    branch was held, shape [3] each, branch frame, with covariance [3, 3]; the gripper's rotation
    there [3, 3], its speed [m/s], shape [3], and ``travel`` [m]; ``seconds`` since the last;
    ``places`` as of :class:`.ExpectedWrench`, [3, 6]."""

    off: np.ndarray
    predicted: np.ndarray
    covariance: np.ndarray
    turn: np.ndarray
    speed: np.ndarray
    travel: float
    seconds: float
    places: np.ndarray = field(default_factory=lambda: np.zeros((3, 6)))


class ForceTest:
    """The test of one motion, or of those with the branch held; ``since``: time since the zero that
    the force is measured from [s], of the tare or of the branch held at rest. The prediction's
    unknown parts: a factor, as a deviation ``gain``, and a fraction ``unknown`` of its largest."""

    def __init__(self, errors: ForceErrors, since: float = 0.0, *, gain: float = _GAIN,
                 unknown: float = _UNKNOWN):
        self._errors, self._unknown = errors, unknown
        zero = _ZERO_NOISE * errors.noise + errors.drift * since
        self._variance = np.diag(np.r_[1.0, gain**2, (_MASS * errors.mass + _MASS_KG)**2, 1.0,
                                       np.full(3, zero**2), np.ones(10)])
        # Of each signal, the difference first: its state, and white sums with the difference and
        # with itself.
        self._sums = [np.zeros((_FIXED, _STATES)), np.zeros(_FIXED), np.zeros(_FIXED)]
        self._turns = np.zeros((3, 3))  # white products of the signals of a turned sensor
        self._onsets = np.zeros((0, 3))  # travel [m], time [s], unit [N]
        self._slipped = np.zeros((0, len(_SLIP_RATES), 3))
        self._time = self._travel = self._largest = 0.0
        self._first: Block | None = None
        self._last: Block | None = None

    def take(self, block: Block, onset: bool | None = None) -> None:
        """Take a block of forces; ``onset``: whether something may begin here, by default as often
        as is looked for."""
        if self._first is None:
            self._first = block
        self._time += block.seconds
        self._travel += block.travel
        self._largest = max(self._largest, length(block.predicted))
        unknown = float(np.hypot(self._unknown * self._largest * self.factor[0],
                                 _COLOURED * self._errors.noise))
        last = self._onsets[-1] if len(self._onsets) else np.zeros(3)
        if onset if onset is not None else (self._travel - last[0] >= _APART_M
                                            or self._time - last[1] >= _APART_S):
            self._begin_onset(unknown)
        weight = STANDARD_GRAVITY * (_DOWN - block.turn @ self._first.turn.T @ _DOWN)
        self._filter(block, weight, unknown, self._signals(block, weight))
        self._last = block

    def _signals(self, block: Block, weight: np.ndarray) -> np.ndarray:
        """The difference and the signal of each hypothesis, shape [9 + 8 onsets, 3]."""
        predicted = block.predicted
        self._slipped -= block.seconds * _SLIP_RATES[:, None] * (predicted + self._slipped)
        since = np.empty((len(self._onsets), _PER_ONSET, 3))
        since[:, 0], since[:, 1:5] = -predicted, self._slipped
        since[:, 5:] = self._onsets[:, 2, None, None] * np.eye(3)
        return np.vstack([block.off, predicted, weight, np.cross(block.turn.T, predicted),
                          self._time * np.eye(3), since.reshape(-1, 3)])

    def _filter(self, block: Block, weight: np.ndarray, unknown: float, signals: np.ndarray,
                ) -> None:
        kept = np.exp(-block.travel / _ALIKE_M - block.seconds / _ALIKE_S)
        factor, walk = np.ones(_STATES), np.zeros(_STATES)
        factor[_CHANGING], walk[_CHANGING] = kept, 1.0 - kept**2
        walk[_ZERO] = self._errors.drift**2 * _DRIFT_SECONDS * block.seconds
        variance = factor[:, None] * self._variance * factor + np.diag(walk)
        state, products, squares = self._sums
        state *= factor
        base = block.places[:, :3]
        deviation, rest = _parts(block.covariance - base @ base.T, block.predicted)
        shape = np.column_stack([
            np.sqrt(1.0 - _CHANGES) * deviation, block.predicted, weight, self._errors.mass
            * (block.speed - (self._last or block).speed) / block.seconds, np.eye(3), _root(
                rest + _CHANGES * np.outer(deviation, deviation) + unknown**2 * np.eye(3)),
            block.places, _AGE_SECONDS / LAID_M * block.places[:, 3:] @ block.speed])
        carried = variance @ shape.T
        spread = np.linalg.cholesky(shape @ carried + self._errors.noise**2 * np.eye(3))
        white = np.linalg.solve(spread, (signals - state @ shape.T).T)
        gain = np.linalg.solve(spread, carried.T)
        state += white.T @ gain
        self._variance = variance - gain.T @ gain
        products += white[:, 0] @ white
        squares += np.einsum("ij,ij->j", white, white)
        self._turns += white[:, _TURNS].T @ white[:, _TURNS]

    def _begin_onset(self, unknown: float) -> None:
        kept = np.arange(len(self._onsets))
        if len(kept) == _MOST_ONSETS:
            # Old ones may be farther apart: the one whose neighbours are nearest for its age goes.
            ages = self._time - self._onsets[:, 1]
            kept = np.delete(kept, 1 + int(np.argmin((ages[:-2] - ages[2:]) / ages[1:-1])))
        rows = np.r_[:_FIXED, (_FIXED + _PER_ONSET * kept[:, None] + np.arange(_PER_ONSET)).ravel()]
        self._sums = [_extended(each[rows], _PER_ONSET) for each in self._sums]
        self._slipped = _extended(self._slipped[kept], 1)
        self._onsets = np.vstack([self._onsets[kept], [self._travel, self._time, unknown]])

    @property
    def factor(self) -> tuple[float, float]:
        """The factor of the predicted force, and its standard deviation."""
        return 1.0 + float(self._sums[0][0, 1]), float(np.sqrt(self._variance[1, 1]))

    @property
    def scale(self) -> tuple[float, float]:
        """The factor of the predicted force that explains the forces so far if nothing else does,
        and its standard deviation."""
        product, square = (float(sums[_SCALE]) for sums in self._sums[1:])
        square = max(square, 1e-300)
        return 1.0 + product / square, square**-0.5

    def alarm(self, least: float = _ALARM) -> str | None:
        """Return the hypotheses, best first, that explain the forces so far far better than the
        prediction, and the force; None if noise and the known errors explain them, by a logarithm
        of the ratio up to ``least``."""
        assert self._last is not None
        _, products, squares = self._sums
        since, own = (sums[_FIXED:].reshape(-1, _PER_ONSET)[:, _COLUMNS_SINCE]
                      for sums in (products, squares))
        since = _log_ratios(since, own, _MEANS_SINCE, _SIGMAS_SINCE)
        ratios = np.r_[_log_ratios(products[_COLUMNS], squares[_COLUMNS], _MEANS, _SIGMAS),
                       self.turned(), since.max(axis=0, initial=-np.inf)]
        if (best := float(ratios.max())) <= least:
            return None
        names = [_NAMES[row] for row in np.argsort(-ratios) if ratios[row] > best - _ALIKE_NATS]
        last = self._last
        return (f"{'; or '.join([*dict.fromkeys(names)][:_MOST_NAMES])}: the force has changed by "
                f"{length(last.off + last.predicted):.2g} N, predicted were "
                f"{length(last.predicted):.2g} N")

    def turned(self, exact: "ForceTest | None" = None) -> float:
        """As :func:`_log_ratios`, of a sensor turned about any axis; beside an ``exact`` test of
        the same blocks what it is at least, as in :meth:`promises`, where blocks are off by what
        such a sensor tells and by no error."""
        products = self._sums[1][_TURNS]
        whole, sure = (np.eye(3) / _TURN_RAD**2 + test._turns for test in (self, exact or self))
        square = float(products @ np.linalg.solve(whole, products))
        if exact is not None:
            spread = np.sqrt(1.0 + products @ np.linalg.solve(sure, products) / max(square, 1e-300))
            square = max(np.sqrt(square) - _CERTAINTY * spread, 0.0)**2
        return float(0.5 * square - 0.5 * np.log(np.linalg.det(_TURN_RAD**2 * whole)))

    def promises(self, exact: "ForceTest", column: int, factor: float, left: float) -> bool:
        """Return whether a signal with that factor of a column raises an alarm by now, with more
        than a certain probability; errors of the prediction are as large as the share of its force
        that is ``left``, and those of the sensor as in an ``exact`` test of the same blocks."""
        square, sure = self._sums[2][column], exact._sums[2][column]
        spread = np.sqrt(left**2 * square + square**2 / max(sure, 1e-300))
        product = np.sign(factor) * max(abs(factor) * square - _CERTAINTY * spread, 0.0)
        return any(at == column and float(_log_ratios(product, square, mean, sigma)) > _ALARM
                   for _, at, mean, sigma in (*_FROM_START, *_SINCE))


_NAMES = [row[0] for row in (*_FROM_START, ("the sensor's axes are turned",), *_SINCE)]
_COLUMNS = [column for _, column, _, _ in _FROM_START]
_COLUMNS_SINCE = [column - _LOST for _, column, _, _ in _SINCE]
_MEANS, _SIGMAS = (np.array([row[k] for row in _FROM_START]) for k in (2, 3))
_MEANS_SINCE, _SIGMAS_SINCE = (np.array([row[k] for row in _SINCE]) for k in (2, 3))


def _log_ratios(product: np.ndarray, square: np.ndarray, mean: np.ndarray | float,
                sigma: np.ndarray | float) -> np.ndarray:
    """The logarithm of the likelihood with a signal over that without, whose factor is normally
    distributed; ``product`` of difference and signal, and the signal's ``square``, white."""
    rest = 1.0 + sigma**2 * square
    return ((2.0 * mean * product - mean**2 * square + sigma**2 * product**2) / (2.0 * rest)
            - 0.5 * np.log(rest))


def _extended(values: np.ndarray, count: int) -> np.ndarray:
    return np.concatenate([values, np.zeros((count, *values.shape[1:]))])


def _root(covariance: np.ndarray) -> np.ndarray:
    """A symmetric root of a covariance [3, 3]: it changes as smoothly along a path as that."""
    squares, axes = np.linalg.eigh(covariance)
    return (axes * np.sqrt(np.maximum(squares, 0.0))) @ axes.T


def _parts(covariance: np.ndarray, predicted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The deviation [3] of a force whose prediction has an unknown factor, as large as its
    covariance [3, 3] allows but not such that E might be nothing; and the covariance's rest."""
    size = length(predicted)
    if size == 0.0:
        return predicted, covariance
    along = predicted / size
    squares, axes = np.linalg.eigh(covariance)
    # A difference of covariances may be a little less than nothing.
    squares = np.maximum(squares, 0.0) + 1e-12 * size**2
    square = 1.0 / float(((axes.T @ along)**2 / squares).sum())
    return (min(np.sqrt(square), size / _NOTHING_OFF) * along,
            (axes * squares) @ axes.T - square * np.outer(along, along))


_WHOLE, _HALF = "from the start", "from half way"
# Columns, the signal's factor, and the share of the predicted force that is left; without a column
# the angle by which the sensor is turned about its own axis.
_FAULTS: tuple[tuple[str, str, tuple[int, ...], float, float], ...] = (
    ("empty gripper", _WHOLE, (_SCALE,), -1.0, 0.0),
    ("branch breaks", _HALF, (_LOST,), 1.0, 0.0),
    ("branch slips by 30 % a second", _HALF, _SLIPS[1:2], 0.75, 1.0),
    ("branch slips by 5 % a second", _HALF, _SLIPS[:1], 1.0, 1.0),
    ("branch three times softer", _WHOLE, (_SCALE,), -2.0 / 3.0, 1.0 / 3.0),
    ("branch three times stiffer", _WHOLE, (_SCALE,), 2.0, 3.0),
    ("sensor reads a tenth", _WHOLE, (_SCALE,), -0.9, 0.1),
    ("sensor's sign", _WHOLE, (_SCALE,), -2.0, 1.0),
    *((f"sensor's axes turned by {angle} degrees", _WHOLE, (), float(np.radians(angle)), 1.0)
      for angle in (45, 20)),
    *((f"another {mass:g} kg in the gripper", _WHOLE, (_LOAD,), mass, 1.0)
      for mass in (0.1, 0.3, 1.0)),
    ("sensor drifts by 0.5 N/s", _WHOLE, _DRIFTS, 0.5, 1.0))


def noticed(path: "Trajectory", errors: ForceErrors, base_turn: np.ndarray) -> list[dict[str, Any]]:
    """Return faults, an empty gripper first, where each ``begins``, and the travel after which the
    guard notices it on a path with expected forces with a probability over 99.8 %, ``after_m``, or
    None if it does not;
    ``base_turn``: the base's rotation in the branch's frame, shape [3, 3]."""
    test, exact = ForceTest(errors), ForceTest(errors, gain=0.0, unknown=0.0)
    # By so much the force is off: in the size of a turn's signal a large turn is not linear.
    turned = {name: (ForceTest(errors), frame_of(np.r_[np.zeros(5), angle])[:3, :3] - np.eye(3))
              for name, _, columns, angle, _ in _FAULTS if not columns}
    after: dict[str, float] = {}
    blocks = list(_blocks(path, base_turn))
    whole = sum(block.travel for block in blocks)
    travel, half = 0.0, None
    for block in blocks:
        begins = half is None and travel >= 0.5 * whole
        half = travel if begins else half
        travel += block.travel
        test.take(block, onset=begins)
        exact.take(replace(block, covariance=np.zeros((3, 3)), places=np.zeros((3, 6))),
                   onset=begins)
        for own, off in turned.values():
            own.take(replace(block, off=block.turn @ off @ block.turn.T @ block.predicted),
                     onset=begins)
        for name, where, columns, factor, left in _FAULTS:
            since = half if where is _HALF else 0.0
            if name not in after and since is not None and (
                    turned[name][0].turned(exact) > _ALARM if not columns else
                    all(test.promises(exact, column, factor, left) for column in columns)):
                # What begins on the way is compared from the next place that is looked from, and
                # the arm stops a block later.
                after[name] = (travel - since + float(2.0 * length(block.speed) * BLOCK_SECONDS)
                               + (_APART_M if where is _HALF else 0.0))
    return [{"fault": name, "begins": where, "after_m": after.get(name)}
            for name, where, *_ in _FAULTS]


def _blocks(path: "Trajectory", base_turn: np.ndarray) -> Iterator[Block]:
    """Blocks of a path as the guard will see them where all goes as predicted."""
    before, first = path.pose(0.0), path.felt(0.0)
    assert first is not None
    for time in np.arange(0.5 * BLOCK_SECONDS, path.duration, BLOCK_SECONDS):
        pose, felt = path.pose(float(time)), path.felt(float(time))
        assert felt is not None
        step = base_turn @ (pose[:3] - before[:3])
        yield Block(np.zeros(3), felt[0][:3] - first[0][:3], felt[2][:3, :3],
                    base_turn @ frame_of(pose)[:3, :3], step / BLOCK_SECONDS, length(step),
                    BLOCK_SECONDS, felt[3])
        before = pose
