"""Around a fit: its initial moduli, errors too large for their squares, pulls it leaves out."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy
from scipy.spatial import cKDTree

from limber.core.errors import WorkError
from limber.core.not_none import present
from limber.core.numerics.rigid import rotated, rotation_matrix
from limber.estimation.fitting.objective import Objective, seen_in
from limber.estimation.fitting.optimise import gauss_newton
from limber.estimation.forward.forward_model import Forward, key_frames, smoothed, travel
from limber.estimation.forward.observed_path import AT_REST_M, ObservedPathForward
from limber.estimation.forward.solved_pull import QuasiStaticForward
from limber.estimation.parameters import LINK_DEVIATION, YOUNG_BOUNDS_PA, Values
from limber.geometry.skeleton.skeleton import Skeleton
from limber.kernels import Kernel
from limber.recordings.recording import Pull, calibration_of

# Initial values of a fit: the moduli for which a beam answers the recorded force as recorded.
#
# The run from base to grasp is a rod of round sections. Force and place of the gripper are
# recorded, so the moment in each section is known as soon as its place is, and the deformed rod
# follows from the base outwards, section by section, for any modulus: no equations are solved, and
# no modulus is without a state. What grows on the run is rigid and weighs on it, where the points
# were seen: a soft branch's own answer to its weight is another for each modulus, and far off for
# a wrong one.

SECTIONS, KEYS = 48, 12
"""Sections of the rod, and frames of a pull that are compared."""
BEAM_M, BEAM_SHARE = 3e-3, 0.03
"""Deviation of the beam's points: constant [m], and a fraction of the longest motion. Chosen."""
DECADES = np.arange(3.0, 12.01, 0.25)
"""Uniform moduli that are tried first, in decades of pascals."""
BEAM_ROUNDS, BEAM_ENDING, ZERO_ROUNDS = 30, 1e-3, 3
"""Most steps of the beam's fit, the relative fall of its cost at which it ends, and steps for the
force's zero with each of the first moduli."""
PARTS = (0.25, 0.45, 0.7)
"""Fractions of a fast pull's frames that are fitted first: over a quarter the simulation cannot be
a whole period off. The fractions between are chosen, not measured.
"""
FEWEST_FRAMES = 6
"""Fewest frames that describe a motion."""
STIFFER = 2.0
"""Factor by which a branch that does not carry its own weight is stiffened at a time."""
MOST_DECADES = 6.0
"""Farthest search for the scale of the moduli where no force gives it."""


class Beam:
    """The run from base to grasp of one pull as a rod: ``axis`` [S + 1, 3] as scanned; frames [k]
    with force and torque [k, 3] at ``place`` [k, 3]; ``seen`` [k, m + 1, 3] and ``rest`` are the
    observed points and, last, the grasp. ``drifts``: the force's zero may drift."""

    def __init__(self, forward: QuasiStaticForward, *, drifts: bool = False):
        self._forward, mesh = forward, forward.mesh
        self.name, self.may_be_off_along = forward.name, forward.may_be_off_along
        self._gravity = forward.model.gravity
        skeleton = present(forward.skeleton, "skeleton of a pulled branch")
        grasp = np.array(forward.entry.grasp.point_m)
        run = _run_to(skeleton, grasp)
        arc = skeleton.arc_length[run] - skeleton.arc_length[run[0]]
        along = np.linspace(0.0, arc[-1], SECTIONS + 1)
        self.axis = np.column_stack([np.interp(along, arc, each) for each in skeleton.nodes[run].T])
        radius = np.interp(0.5 * (along[1:] + along[:-1]), arc, skeleton.radius[run])
        self._second = np.pi / 4 * radius**4
        self._step = np.diff(self.axis, axis=0)
        # What grows on the run moves with the section that carries it.
        section = np.full(skeleton.node_count, -1)
        section[run] = np.rint(arc / along[1]).astype(int)
        for node in np.flatnonzero(section < 0):
            section[node] = section[skeleton.parent[node]]
        tree = cKDTree(skeleton.nodes)
        self._field = forward.field.on(
            cKDTree(mesh.centroids).query(self.axis[:-1] + 0.5 * self._step)[1])
        self.rest = np.vstack([forward.rest_points, grasp])
        self._at = np.r_[section[tree.query(forward.rest_points)[1]], SECTIONS].astype(int)
        added = forward.model.point_masses
        twigs = forward.lumping.twigs if forward.lumping is not None else ()
        centres = np.vstack([mesh.centroids, *(each.position for each in (*twigs, *added))])
        at = section[tree.query(centres)[1]]
        # Of wood its volume, of what was added its mass.
        amounts = np.r_[
            np.abs(mesh.volumes), [each.mass / np.mean(forward.model.density) for each in twigs],
            [each.mass for each in added]]
        is_added = (np.arange(len(at)) >= len(at) - len(added)).astype(int)
        self._carried = np.zeros((2, SECTIONS + 1, 4))
        np.add.at(self._carried, (is_added, at), amounts[:, None] * np.column_stack(
            [np.ones(len(at)), centres - self.axis[at]]))
        self._record(forward, grasp, drifts)

    def _record(self, forward: QuasiStaticForward, grasp: np.ndarray, drifts: bool) -> None:
        """Smooth what was recorded at few frames."""
        frames, entry = forward.frames, forward.entry
        self.is_loaded = entry.drive == "force"
        known = np.isfinite(frames.wrenches[:, :3]).all(axis=1)
        along = np.arange(len(frames)) if self.is_loaded else travel(frames.poses)
        keys = np.flatnonzero(known)[key_frames(along[known], KEYS)[0]]
        self.times = frames.times[keys]

        def at_keys(values: np.ndarray) -> np.ndarray:
            enough = np.isfinite(values).sum() > 3
            return smoothed(frames.times, values[:, None], self.times)[:, 0] if enough else (
                values[keys])

        wrench = np.column_stack([at_keys(each) for each in frames.wrenches.T[
            :6 if forward.uses_torque else 3]])
        self.place = frames.poses[keys, :3]
        off = grasp - self.place[0]
        cell = calibration_of(entry)
        zero = np.full(len(frames), cell.force_bias_sigma_n)
        if not self.is_loaded and np.linalg.norm(off) < AT_REST_M:
            # The sensor's reading at rest is its zero, which drifts from there.
            wrench, self.place = wrench - wrench[0], self.place + off
            zero = drifts * cell.force_drift_sigma_n * np.linspace(0.0, 1.0, len(frames))
        self.zero_sigma, self._keys = zero[:, None] * (not self.is_loaded), keys
        self.force = wrench[:, :3]
        self.torque = wrench[:, 3:] if wrench.shape[1] == 6 else np.zeros_like(self.force)
        points = frames.positions.reshape(len(frames), -1)
        self.seen = np.concatenate([np.reshape([at_keys(each) for each in points.T], (
            -1, len(keys))).T.reshape(len(keys), -1, 3), np.where(
                self.is_loaded, np.nan, self.place)[:, None]], axis=1)
        self._motion = self.seen - (self.rest if self.is_loaded else self.seen[0])
        self._places, self._turns = self._recorded()
        if self.is_loaded:
            self.place = self._places[:, -1] + self.rest[-1] - self.axis[-1]

    def _recorded(self) -> tuple[np.ndarray, np.ndarray]:
        """Places [k, S + 1, 3] and rotations [k, S + 1, 3, 3] of the sections between the points
        that were seen, without twist."""
        seen = np.isfinite(self._motion).all(axis=(0, 2)) & (self._at > 0)
        at, first = np.unique(self._at[seen], return_index=True)
        moved = np.zeros((len(self.force), SECTIONS + 1, 3))
        if len(at):
            through = scipy.interpolate.CubicSpline(
                np.r_[0, at], np.insert(self._motion[:, seen][:, first], 0, 0.0, axis=1), axis=1,
                bc_type=("clamped", "natural"))
            # Beyond the last one it is straight.
            beyond = np.maximum(np.arange(SECTIONS + 1) - at[-1], 0)[:, None]
            moved = through(np.minimum(np.arange(SECTIONS + 1), at[-1])) + (
                beyond * through(at[-1], 1)[:, None])
        places = self.axis + moved
        before, after = (each / np.linalg.norm(each, axis=-1, keepdims=True) for each in (
            np.gradient(self.axis, axis=0), np.gradient(places, axis=1)))
        sine = np.cross(before, after)
        angle = np.arctan2(np.linalg.norm(sine, axis=-1), (before * after).sum(axis=-1))
        vectors = sine / np.sinc(angle / np.pi)[..., None]
        return places, rotation_matrix(vectors.reshape(-1, 3)).reshape(*places.shape, 3)

    def bent(self, values: Sequence[Values], zeros: np.ndarray | float = 0.0,
             ) -> tuple[np.ndarray, np.ndarray]:
        """Return ``rest`` moved under each of b values, [b, k, m + 1, 3], and sections' rotations
        there [b, k, m + 1, 3, 3]; the force read is too large by ``zeros`` [b, k, 3] [N]."""
        young = np.array([self._field.young(each) for each in values])
        stiffness = young * self._second, young * self._second / (1 + values[0].poisson)
        carried = values[0].density * self._carried[0] + self._carried[1]
        held = self._hung(carried, self.axis, np.eye(3)) * (
            self._forward.model.prestress is not None)
        shape = (len(values), len(self.force), SECTIONS + 1, 3)
        places, turns = np.empty(shape), np.empty((*shape, 3))
        _bend_rods.of(
            self.axis, *stiffness, np.broadcast_to(self.force - zeros, (*shape[:2], 3)),
            self.torque, np.broadcast_to(self.place, (*shape[:2], 3)),
            _from_end(carried[:, :1] * self._gravity), np.broadcast_to(
                self._hung(carried, self._places, self._turns), shape),
            held, places, turns)
        found = turns[:, :, self._at]
        return places[:, :, self._at] + np.einsum(
            "bkmij,mj->bkmi", found, self.rest - self.axis[self._at]), found

    def _hung(self, carried: np.ndarray, places: np.ndarray, turns: np.ndarray) -> np.ndarray:
        """Moment of the weight from each section on about the origin, [..., S + 1, 3]."""
        arms = (turns @ carried[:, 1:, None])[..., 0]
        return _from_end(np.cross(carried[:, :1] * places + arms, self._gravity))

    def residuals(self, values: Sequence[Values], zeros: np.ndarray) -> np.ndarray:
        """Difference of simulated and recorded motions over their deviation, [b, r]: from the
        first frame on, as places at rest may be wrong; under a stated load, from rest. ``zeros``
        [b, 1, 3]: of the force, or how far it has drifted, over their deviation."""
        moved, _ = self.bent(values, zeros * self.zero_sigma[self._keys])
        off = moved - (self.rest if self.is_loaded else moved[:, :1]) - self._motion
        size = float(np.nanmax(np.linalg.norm(self._motion, axis=-1), initial=0.0))
        return np.nan_to_num(off / (BEAM_M + BEAM_SHARE * size)).reshape(len(values), -1)

    def shifts(self, begun: "BeamStart") -> np.ndarray:
        """Distances of the observed points along the branch from where they are stated [m], [m]."""
        sigma = calibration_of(self._forward.entry).point_sigma_m
        moved, turns = self.bent([begun.values], begun.zeros[self.name][self._keys])
        axis = np.gradient(self.axis, axis=0)[self._at[:-1]]
        axis = np.einsum("kmij,mj->kmi", turns[0, :, :-1],
                         axis / np.linalg.norm(axis, axis=1, keepdims=True))
        off = np.nanmean(np.sum((self.seen - moved[0])[:, :-1] * axis, axis=2), axis=0)
        return np.nan_to_num(off) * sigma**2 / (sigma**2 + BEAM_M**2)


def _run_to(skeleton: Skeleton, point: np.ndarray) -> np.ndarray:
    """Nodes from the base to the one nearest to a point."""
    run = [int(np.linalg.norm(skeleton.nodes - point, axis=1).argmin())]
    while skeleton.parent[run[-1]] >= 0:
        run.append(int(skeleton.parent[run[-1]]))
    return np.array(run[::-1])


def _from_end(values: np.ndarray) -> np.ndarray:
    """Sum from each section outwards; the section is the last axis but one."""
    return np.flip(np.cumsum(np.flip(values, axis=-2), axis=-2), axis=-2)


_bend_rods = Kernel(
    "rods_bent", "axis float64[sections, 3]", "bending float64[beams, elements]",
    "twist float64[beams, elements]", "force float64[beams, frames, 3]",
    "torque float64[frames, 3]", "grasp float64[beams, frames, 3]", "weight float64[sections, 3]",
    "hung float64[beams, frames, sections, 3]", "held float64[sections, 3]",
    "out places float64[beams, frames, sections, 3]",
    "out turns float64[beams, frames, sections, 3, 3]")
"""Fill places and rotations of the sections, from the base on. Each turns by the moment at its
middle: of the gripper (``force``) and of the ``weight`` from there on, with moment ``hung`` about
the origin, less that as scanned, ``held``. Stiffnesses are in N m^2."""


@dataclass(frozen=True)
class BeamStart:
    """Moduli by beam theory, which part of the recorded motion they explain (0 to 1), and by pull
    the zero [N], [f, 3], of a force that drifts, or was not read at rest."""

    values: Values
    explained: float
    zeros: Mapping[str, np.ndarray]


EXPLAINED = 0.5
"""Part of the recorded motion that some modulus has to explain. Chosen: sound pulls reach 0.9."""


def unexplained(begun: BeamStart) -> str:
    """A sentence for a start that explains little."""
    return (f"Before the fit: no Young's modulus explains more than {100 * begun.explained:.0f} % "
            "of the motion by the recorded force. Check in which frame the force was recorded and "
            "its sign, the clocks, the grasp point, and the order of the markers.")


def beams_of(forwards: Sequence[Forward], *, drifts: bool = False) -> list[Beam]:
    """The slow pulls with a measured force as rods."""
    return [Beam(forward, drifts=drifts) for forward in forwards if forward.uses_force
            and isinstance(forward, QuasiStaticForward) and forward.skeleton is not None]


def far_from_stated(beams: Sequence[Beam], begun: BeamStart) -> dict[str, np.ndarray]:
    """Distances of pulls' points along the branch [m], by name, where one is far."""
    found = {beam.name: beam.shifts(begun) for beam in beams
             if beam.may_be_off_along and not beam.is_loaded}
    return {name: each for name, each in found.items() if np.abs(each).max(initial=0) > FAR_M}


def beam_start(beams: Sequence[Beam], base: Values) -> BeamStart:
    """Fit rods to their pulls: uniform moduli of all decades first, then one at each control point;
    with each the drift of a force, or its zero if it was not read at rest. It does not depend on
    the moduli of ``base``."""
    count, step = len(base.young), 1e-3
    size = count + 3 * len(beams)

    def residuals(free: np.ndarray) -> np.ndarray:
        values = [replace(base, young=np.exp(each[:count])) for each in free]
        zeros = np.moveaxis(free[:, count:].reshape(len(free), -1, 1, 3), 1, 0)
        return np.hstack([*(beam.residuals(values, each) for beam, each in zip(
            beams, zeros, strict=True)),
            np.diff(free[:, :count], axis=1) / LINK_DEVIATION, free[:, count:]])

    tried = np.zeros((len(DECADES), size))
    tried[:, :count] = np.log(10) * DECADES[:, None]
    for _ in range(ZERO_ROUNDS):
        rows = [residuals(tried + step * each) for each in np.eye(size)[count:]]
        now = residuals(tried)
        slopes = (np.array(rows) - now).transpose(1, 2, 0) / step
        tried[:, count:] -= np.array([np.linalg.lstsq(*each, rcond=None)[0]
                                      for each in zip(slopes, now, strict=True)])
    costs = np.sum(residuals(tried)**2, axis=1)

    def slopes_at(free: np.ndarray) -> np.ndarray:
        rows = residuals(np.vstack([free, free + step * np.eye(size)]))
        return (rows[1:] - rows[0]).T / step

    bound = np.where(np.arange(size) < count, np.log(YOUNG_BOUNDS_PA)[:, None],
                     [[-np.inf], [np.inf]])
    found = scipy.optimize.least_squares(
        lambda free: residuals(free[None])[0], np.clip(tried[costs.argmin()], *bound), slopes_at,
        bounds=bound, ftol=BEAM_ENDING, max_nfev=BEAM_ROUNDS)
    zeros = {beam.name: beam.zero_sigma * each
             for beam, each in zip(beams, found.x[count:].reshape(-1, 3), strict=True)}
    explained = 1 - 2 * float(found.cost) / max(float(costs[-1]), 1e-300)
    return BeamStart(replace(base, young=np.exp(found.x[:count])), explained, zeros)


def scaled_start(objective: Objective, values: Values, *, drifts: bool = False) -> Values:
    """Return moduli under which the branch stands and answers the measured force as recorded,
    perhaps less a drift, from which the pulls then begin. A fast pull is fitted step by step;
    without a force, or where the stiffest rod fits best, some decades are tried."""
    if any(forward.is_dynamic for forward in objective.forwards):
        return _step_by_step(objective, values)
    beams = beams_of(objective.forwards, drifts=drifts)
    begun = beam_start(beams, values) if beams else None
    if begun is None or begun.values.young.max() >= 0.9 * YOUNG_BOUNDS_PA[1]:
        return _scanned(objective, standing(objective, values))
    for forward in objective.forwards:
        if isinstance(forward, ObservedPathForward):
            forward.begin_without(begun.zeros[forward.name])
    return standing(objective, begun.values)


def standing(objective: Objective, values: Values) -> Values:
    """Return the values with all moduli so much stiffer that the branch carries its own weight."""
    while values.young.max() < YOUNG_BOUNDS_PA[1] and not all(
            forward.stands(values) for forward in objective.forwards):
        values = replace(values, young=np.clip(STIFFER * values.young, *YOUNG_BOUNDS_PA))
    return values


def _step_by_step(objective: Objective, values: Values) -> Values:
    """Fit the beginning of fast pulls first, then growing parts. A branch with wrong moduli
    oscillates at other frequencies, and later its phase is arbitrary. In a quarter of the frames it
    cannot be a whole period off; the result predicts the next part."""
    space = objective.space
    likely = space.linked(tuple((k, k - 1) for k in range(1, space.group_count)))
    for number, part in enumerate(PARTS):
        forwards = [forward.until(max(int(part * len(forward.frames)), FEWEST_FRAMES))
                    for forward in objective.forwards]
        short = objective.with_space(likely, forwards)
        if number == 0:
            values = _scanned(short, standing(short, values))
        fit = gauss_newton(short, likely.pack(values), evaluation_limit=12, tolerance=1e-2,
                           force_rounds=1)
        values = likely.unpack(fit.evaluation.free)
        objective.forward_count = short.forward_count
    return values


def _scanned(objective: Objective, values: Values) -> Values:
    """Descend over decades, then halve the step: the objective has one valley along the scale.
    Moduli without equilibrium are too soft: the search begins at the first with one."""
    tried: dict[float, float | None] = {}

    def scaled(shift: float) -> Values:
        return replace(values, young=np.clip(values.young * 10**shift, *YOUNG_BOUNDS_PA))

    def cost(shift: float) -> float | None:
        if shift not in tried:
            found = objective.evaluate(objective.space.pack(scaled(shift)))
            tried[shift] = None if found is None else found.objective
        return tried[shift]

    centre, step = 0.0, 1.0
    while cost(centre) is None:
        if scaled(centre).young.max() >= YOUNG_BOUNDS_PA[1]:
            return values
        centre += step
    while step >= 0.25 and abs(centre) <= MOST_DECADES:
        best = min((known, shift) for shift in (centre, centre - step, centre + step)
                   if (known := cost(shift)) is not None)[1]
        step, centre = step / 2 if best == centre else step, best
    return scaled(centre)


# Errors so large that their squares matter: put right by what was fitted, then fitted again.
#
# The errors of a fit are linear. A frame of the observed points that is turned by several degrees
# is turned back, and a point that is a centimetre off along a bent branch is moved there.

ROUNDS = 4
"""Most fits. 20 degrees need three."""
SMALL_RAD = 5e-3
"""Turn below which its square no longer matters: 0.01 mm at half a metre."""
FAR_M = 4e-3
"""Distance along the branch beyond which a point is moved: with a radius of curvature of 15 cm its
square is 0.05 mm.
"""


def far_points(cell_errors: Sequence[dict], known: Mapping[str, np.ndarray],
               ) -> dict[str, np.ndarray] | None:
    """Return each pull's fitted distances of its points along the branch [m]; None if they are near
    those simulated, ``known`` by the pull's name (absent: zero)."""
    found: dict[str, list[float]] = {}
    for each in cell_errors:
        if re.fullmatch("position of point [0-9]+ along the branch", each["name"]):
            found.setdefault(each["pull"], []).append(each["value"])
    fitted = {name: np.array(values) for name, values in found.items()}
    is_far = any(np.abs(values - known.get(name, 0.0)).max() > FAR_M
                 for name, values in fitted.items())
    return fitted if is_far else None


def fitted_frame(cell_errors: Sequence[dict]) -> tuple[np.ndarray, np.ndarray]:
    """Return the fitted shift [m] and turn [rad] of the observer's frame, shape [3] each."""
    def vector(start: str) -> np.ndarray:
        return np.array([each["value"] for each in cell_errors
                         if each["name"].startswith(start)] or np.zeros(3))

    return vector("camera position"), vector("camera rotation")


def put_right(pull: Pull, shift: np.ndarray, turn: np.ndarray, middle: np.ndarray) -> Pull:
    """Return the pull with its points in the branch's frame, turned back about ``middle`` [3], that
    of the first pull's points at rest: all pulls have one observer."""
    seen = present(pull.observations, "observed points")
    points = seen.positions - shift
    back = rotated(-turn, (points - middle).reshape(-1, 3)).reshape(points.shape)
    return replace(pull, observations=replace(seen, positions=middle + back))


# Pulls that a fit leaves out, and how well it predicts them.


def held_out(objective: Objective, free: np.ndarray, index: int) -> tuple[float, float]:
    """RMS distance [m] of points and RMS force error [N] of one pull that was not used in a fit.
    WorkError if the pull has no equilibrium under these values."""
    forward = objective.forwards[index]
    simulated = forward.simulate(objective.space.unpack(free), (), False)
    if simulated is None:
        raise WorkError(f"{forward.name} cannot be predicted: the simulation finds no equilibrium.",
                        "The moduli of the other pulls do not carry its forces.",
                        "Check this pull's grasp point, frame of reference and units.")
    simulated = forward.under_readings(simulated)
    off = (simulated.positions - forward.frames.positions)[seen_in(forward.frames)]
    force = simulated.forces - forward.frames.wrenches[:, :3]
    force = force[np.isfinite(force).all(axis=1)]
    return (float(np.sqrt(np.mean(np.sum(off**2, axis=1)))) if len(off) else np.nan,
            float(np.sqrt(np.mean(np.sum(force**2, axis=1)))) if len(force) else np.nan)


def without(objective: Objective, index: int) -> Objective:
    """Return the objective on all pulls but one; it keeps no log."""
    kept = [k for k in range(len(objective.forwards)) if k != index]
    return Objective([objective.forwards[k] for k in kept], objective.space,
                     force_sigma=[objective.force_sigma[k] for k in kept])
