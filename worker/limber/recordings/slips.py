"""Slips of a recording: another unit, frame or order than stated, named before a fit.

Limits of robots give units away. How a branch bends gives frames away: as a beam of round sections,
whose stiffness comes from the scan's radii, it says in which direction a force moves the gripper,
and where the points between go. Its modulus, and the force's zero and drift within the calibration,
are free. A frame is named if with it the pull fits much better than as stated; what fits as well
is named too. Nothing is corrected: the user chooses.
"""

from dataclasses import dataclass
from itertools import permutations, product

import numpy as np
import scipy
from scipy.spatial.transform import Rotation

from limber.core.alignment import Alignment
from limber.core.errors import InputError, Option, Text
from limber.core.not_none import present
from limber.core.numerics.rigid import rotation_matrix, rotation_vector
from limber.geometry.skeleton.skeleton import Skeleton
from limber.recordings.recording import Pull, calibration_of
from limber.recordings.sensor_checks import force_unit_suspicion

_CHANCE = 0.05
"""Probability with which the best of all axes may fit by chance, for them to be named."""
_FASTEST_M_S, _LONGEST_S = 5.0, 3600.0
"""Of a robot's tool; of a pull."""
_THOUSAND = (300.0, 3000.0)
"""Ratios of two durations that show milliseconds beside seconds."""
_BEAM_ERROR, _TORQUE_ERROR, _AXIAL_ERROR = 0.2, 0.3, 0.5
"""Relative error of the beam's forces across the branch, with a torque, and along it. On rods of
generated branches, pulled by up to 0.35 of their length, the first was at most 0.1."""
_POINT_ERROR, _WAY_ERROR = 0.3, 0.1
"""Relative error of how far a point goes, and then of its course."""
_FRAMES_COUNT = 12
"""Frames that count as independent: the beam's error is the same in neighbours."""
_MUCH_BETTER, _AS_WELL = 12.0, 6.0
"""Differences of chi-squared from which a frame is named, and up to which another fits as well."""
_FOLLOWS = 0.5
"""Fraction of its misfit that points have left with another offset of the clocks that is named."""
_NOISES = 8.0
"""Noises of the force that its change must exceed to have a direction; noise alone reaches six."""
_LEAST_PIECES = 24
"""Pieces of the beam."""
AS_POSES = "poses"
_DEGREES = (10.0, 150.0)
"""Ratios of recorded to expected rotations that show degrees: 57, and the beam's error."""


def require_no_slip(pull: Pull) -> Pull:
    """Return the pull, with a warning if it has no force. InputError, with the likely slip, if
    times, positions, rotations or forces cannot be those of a robot."""
    name, times, poses = pull.name, pull.times, pull.poses
    length = float(np.ptp(times))
    seen = None if pull.observations is None else float(np.ptp(pull.observations.times))
    for what, one, other in (() if not seen or not length else (
            ("gripper", length, seen), ("markers", seen, length))):
        if _THOUSAND[0] < one / other < _THOUSAND[1]:
            raise InputError(f"{name}: the times of the {what} span {one:.4g} s, those of the "
                             f"other table {other:.4g} s.", "They are likely milliseconds.",
                             "Name the unit in the title of that column, such as t_ms.")
    if length > _LONGEST_S:
        raise InputError(f"{name}: the times of the gripper span {length:.4g} s.",
                         "No pull lasts longer than an hour. They are likely milliseconds or "
                         "microseconds.", "Name the unit in the title of the column: t_ms, t_us.")
    speed = float(np.nanmax(np.linalg.norm(np.diff(poses[:, :3], axis=0), axis=1) / np.diff(times),
                            initial=0.0))
    if speed > _FASTEST_M_S:
        raise InputError(f"{name}: the gripper moves at up to {speed:.3g} m/s.",
                         f"No robot's tool moves faster than {_FASTEST_M_S:g} m/s. The positions "
                         "are likely in millimetres, or the times in another unit.",
                         "Name the units in the titles, such as x_mm and t_ms.")
    force = pull.wrenches[:, :3]
    if not np.isfinite(force).any():
        return pull.warned(
            f"{name}: the table has no force (columns fx_n, fy_n, fz_n). Without it a pull does "
            "not determine the modulus, only its course along the branch.")
    if not np.nan_to_num(force).any():
        raise InputError(f"{name}: the force is zero in all {len(force)} rows.",
                         "A sensor that was read has noise. It was not connected, or not recorded.",
                         "Record it again with the force; or, if there was no sensor, remove the "
                         "columns of the force and torque.")
    return pull


AXES = {f"{a}{'xyz'[i]},{b}{'xyz'[j]},{c}{'xyz'[k]}": np.array(
            [-1.0 if sign else 1.0 for sign in (a, b, c)])[:, None] * np.eye(3)[[i, j, k]]
        for i, j, k in permutations(range(3)) for a, b, c in product(("", "-"), repeat=3)}
"""Frames with axes of other names or signs: rows give x, y and z by the recorded columns."""


def likely_slip(points: np.ndarray, nodes: np.ndarray, alignment: Alignment, near: float) -> str:
    """Return which slip explains points [m], shape [n, 3], farther than ``near`` [m] from the
    branch's nodes [k, 3], as a sentence; "" if none does, or turned at random they come as near.
    ``alignment``: from the scan's coordinates."""
    nearest = scipy.spatial.cKDTree(nodes)

    def off(moved: np.ndarray) -> float:
        return float(nearest.query(moved)[0].max())

    for factor, unit in ((1e-3, "millimetres"), (1e-2, "centimetres")):
        # Nearer points would all fit at the root.
        if np.abs(points).max() > 5 * np.abs(nodes).max() and off(factor * points) <= near:
            return f"They fit as {unit}: name the unit in the titles, such as x_{unit[0]}m."
    recorded = alignment.undo(points) * alignment.scale
    away = {name: min(off(points @ turn.T), off(alignment.apply_metres(recorded @ turn.T)))
            for name, turn in AXES.items() if name != "x,y,z"}
    name = min(away, key=lambda each: away[each])
    if off(alignment.apply_metres(points)) <= min(near, away[name]):
        return Text("They fit in the frame of the scan: state ", Option("coordinates", "scan"), ".")
    turns = Rotation.from_quat(np.random.default_rng(0).standard_normal((1000, 4))).as_matrix()
    share = np.mean([off(points @ turn.T) <= away[name] for turn in turns])
    if away[name] <= near and 1 - (1 - share) ** len(away) < _CHANCE:
        if "-" in name:
            return f"They fit with other axes: x, y, z of the branch are {name} of the table."
        return ("They fit with the titles x, y, z exchanged: the columns titled x, y, z are "
                f"likely {', '.join('xyz'[name.split(',').index(axis)] for axis in 'xyz')}.")
    return ""


@dataclass(frozen=True)
class Frames:
    """Rotations [3, 3] to the branch of the frame of the poses, and of the scan."""

    poses: np.ndarray
    scan: np.ndarray

    def on_branch(self, frame: str, poses: np.ndarray, wrenches: np.ndarray) -> np.ndarray:
        """Return wrenches [n, 6], read in the poses' frame, as those of a stated frame: ``poses``,
        ``tool`` (the gripper's own), ``scan``, or axes as in AXES. Poses [n, 6] and both wrenches
        are in the branch's frame."""
        if frame == AS_POSES:
            return wrenches
        turn = (rotation_matrix(np.nan_to_num(poses[:, 3:])) if frame == "tool"
                else (self.scan if frame == "scan" else self.poses @ AXES[frame])[None])
        return np.hstack([np.einsum("nij,nj->ni", np.broadcast_to(turn, (len(poses), 3, 3)),
                                    part @ self.poses) for part in np.hsplit(wrenches, 2)])


@dataclass(frozen=True)
class Cantilever:
    """The branch from base to grasp [m] as a beam of 1 Pa: middles of its pieces [N, 3], and their
    rotation by a moment [1/(N m)], [N, 3, 3]."""

    grasp: np.ndarray
    middles: np.ndarray
    flexibility: np.ndarray

    @classmethod
    def of(cls, skeleton: Skeleton, grasp: np.ndarray) -> "Cantilever | None":
        """Return the beam to a grasp [m], [3]; None if that is at the base."""
        path = [int(np.linalg.norm(skeleton.nodes - grasp, axis=1).argmin())]
        while skeleton.parent[path[-1]] >= 0:
            path.append(int(skeleton.parent[path[-1]]))
        path = path[::-1]
        last = len(path) - 1
        known = np.c_[np.vstack([skeleton.nodes[path[:-1]], grasp]), skeleton.radius[path]]
        # An axis of few points is cut finer, as the moment changes along it.
        at = np.linspace(0, last, last * -(-_LEAST_PIECES // max(last, 1)) + 1)
        fine = np.column_stack([np.interp(at, np.arange(last + 1), values) for values in known.T])
        nodes, radius = fine[:, :3], fine[:, 3]
        steps = np.diff(nodes, axis=0)
        sizes = np.linalg.norm(steps, axis=1)
        if not len(sizes) or not sizes.all():
            return None
        along = steps / sizes[:, None]
        second = np.pi / 4 * np.convolve(radius, [0.5, 0.5], "valid")**4
        # Twist: 1 / (G J) with J = 2 I and Poisson's ratio 0.35.
        sides = np.eye(3) + 0.35 * np.einsum("ni,nj->nij", along, along)
        return cls(grasp, (nodes[1:] + nodes[:-1]) / 2, sides * (sizes / second)[:, None, None])

    def stiffest_axis(self) -> np.ndarray:
        """Return the direction in which a force at the grasp bends the beam least, [3]."""
        levers = (self.grasp - self.middles)[None]
        return _across(self.responses(levers, levers)[0][0])[1][:, 0]

    def bent(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return rotations and displacements of the middles, [n, N, 3] each, for the grasp at
        positions [m], [n, 3]."""
        levers = self.grasp - self.middles
        stiff, _ = _across(self.responses(levers[None], levers[None])[0][0])
        moments = np.cross(levers[None], ((positions - self.grasp) @ stiff.T)[:, None])
        turns = np.cumsum(np.einsum("nij,tnj->tni", self.flexibility, moments), axis=1)
        steps = np.cross(turns[:, :-1], np.diff(self.middles, axis=0)[None])
        # A bent branch ends nearer to its base.
        steps = steps + 0.5 * np.cross(turns[:, :-1], steps)
        return turns, np.cumsum(np.pad(steps, ((0, 0), (1, 0), (0, 0))), axis=1)

    def responses(self, levers: np.ndarray, mean: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Displacement of the grasp by force and torque [n, 3, 3], for levers [n, N, 3] from the
        bent beam, and their means with those at rest."""
        turned = np.einsum("nij,tnjk->tnik", self.flexibility, _crossing(levers))
        arms = -_crossing(mean)
        return (np.einsum("tnij,tnjk->tik", arms, turned),
                np.einsum("tnij,njk->tik", arms, self.flexibility))


def _crossing(vectors: np.ndarray) -> np.ndarray:
    """Matrices that give the cross product with vectors, [..., 3] to [..., 3, 3]."""
    return np.cross(vectors[..., None, :], np.eye(3)).swapaxes(-1, -2)


def _across(response: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Stiffness across the beam [3, 3], and its axes, the stiffest (along it) first, as columns."""
    sizes, axes = np.linalg.eigh((response + response.T) / 2)
    return axes[:, 1:] / sizes[1:] @ axes[:, 1:].T, axes


@dataclass(frozen=True)
class _Explained:
    """How a frame fits: chi-squared, the relative misfit, and its modulus [Pa] if sure."""

    chi_squared: float
    misfit: float
    young: float | None = None


def _blocks(pull: Pull) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Poses and median wrenches of some 60 parts of a pull [n, 6]; the force's change over them,
    and its noise there [N]."""
    rows = np.flatnonzero(np.isfinite(pull.wrenches[:, :3]).all(axis=1)
                          & np.isfinite(pull.poses).all(axis=1))
    parts = [part for part in np.array_split(rows, 60) if len(part)]
    wrenches = np.array([np.median(np.nan_to_num(pull.wrenches[part]), axis=0) for part in parts])
    return (np.array([pull.poses[part[len(part) // 2]] for part in parts]), wrenches,
            float(max((np.linalg.norm((each - wrenches[0])[:3]) for each in wrenches), default=0)),
            pull.entry.sensor.force_sigma_n / max(len(rows) // 60, 1)**0.5)


def explained_forces(pull: Pull, beam: Cantilever, known: Frames) -> dict[str, _Explained]:
    """How each frame of the force explains the gripper's motion; empty if there is none."""
    poses, wrenches, change, _ = _blocks(pull)
    if (len(poses) < 6 or pull.entry.motion != "quasi_static"
            or np.linalg.norm(np.ptp(poses[:, :3], axis=0)) < 5e-3):
        return {}
    positions = poses[:, :3]
    rest = (beam.grasp - beam.middles)[None]
    levers = positions[:, None] - (beam.middles + beam.bent(positions)[1])
    by_force, by_torque = beam.responses(levers, (levers + rest) / 2)
    stiff, axes = _across(beam.responses(rest, rest)[0][0])
    by_force = stiff @ by_force + np.outer(axes[:, 0], axes[:, 0])
    by_torque = stiff @ by_torque * (pull.entry.grasp.mode == "rigid")
    expected = (positions - beam.grasp) @ stiff.T
    error = _TORQUE_ERROR if by_torque.any() and wrenches[:, 3:].any() else _BEAM_ERROR
    drift = max(calibration_of(pull.entry).force_drift_sigma_n, 0.02 * change)

    def explained(frame: str) -> _Explained:
        force, torque = np.hsplit(known.on_branch(frame, poses, wrenches), 2)
        parts = [np.einsum("nij,nj->ni", each, load) for each, load in (
            (by_force, force), (by_torque, torque))]
        size = np.sqrt(np.mean(sum(np.linalg.norm(each - each[0], axis=1)
                                   for each in (force, parts[1]))**2))
        weight = axes / (size * np.array([_AXIAL_ERROR, error, error])) * (
            min(len(force), _FRAMES_COUNT) / len(force))**0.5
        since = np.linspace(0.0, 1.0, len(force))[:, None, None]
        terms = np.concatenate([expected[:, :, None], by_force, since * by_force], axis=2)
        rows = np.einsum("nik,ij->njk", terms, weight).reshape(-1, 7)
        rows = np.vstack([rows, np.eye(7)[4:] / drift])
        target = np.r_[((parts[0] + parts[1]) @ weight).ravel(), np.zeros(3)]
        solved = scipy.optimize.lsq_linear(rows, target, ([0.0] + 6 * [-np.inf], np.inf))
        chi_squared = 2.0 * float(solved.cost)
        without = scipy.optimize.lsq_linear(rows[:, 1:], target)
        is_sure = 2.0 * float(without.cost) > chi_squared + _MUCH_BETTER
        return _Explained(chi_squared, error * (chi_squared / _FRAMES_COUNT)**0.5,
                          float(solved.x[0]) if is_sure else None)

    is_turned = not np.allclose(known.scan, np.eye(3))
    return {frame: explained(frame) for frame in (AS_POSES, "tool", *["scan"] * is_turned, *AXES)
            if frame != "x,y,z"}


def explained_points(pull: Pull, beam: Cantilever, turn: np.ndarray, lag: float) -> _Explained:
    """How well observed points, turned by [3, 3] and ``lag`` [s] later, follow the gripper; how far
    each goes is known less well than where to."""
    seen = present(pull.observations, "observed points")
    late = seen.times + pull.entry.time_offset_s + lag
    rows = np.flatnonzero((late >= pull.times[0]) & (late <= pull.times[-1]))
    rows = rows[::max(len(rows) // 60, 1)]
    whole = seen.visible[rows].all(axis=0)
    if len(rows) < 6 or not whole.any():
        return _Explained(np.inf, np.inf)
    turns, moved = beam.bent(np.column_stack([
        np.interp(late[rows], pull.times, axis) for axis in pull.poses[:, :3].T]))
    points = seen.positions[rows][:, whole]
    # Only the ways may be turned: the places were perhaps found otherwise.
    first, away = min(((each, np.linalg.norm(each[:, None] - beam.middles, axis=2))
                       for each in (points[0], points[0] @ turn.T)),
                      key=lambda pair: pair[1].min(axis=1).max())
    near = away.argmin(axis=1)
    arms = first - beam.middles[near]
    expected, found = (each - each.mean(axis=0) for each in (
        moved[:, near] + np.cross(turns[:, near], arms), points @ turn.T))
    size = np.sum(expected**2, axis=(0, 2)) / len(rows)
    weight = min(len(rows), _FRAMES_COUNT) / len(rows) / (
        _WAY_ERROR**2 * size + 9 * pull.entry.sensor.position_sigma_m**2)
    scale = (weight * np.sum(expected * found, axis=(0, 2)) + _POINT_ERROR**-2) / (
        weight * np.sum(expected**2, axis=(0, 2)) + _POINT_ERROR**-2)
    off = np.sum((found - scale[:, None] * expected)**2, axis=(0, 2))
    return _Explained(float(weight @ off + np.sum((scale - 1)**2) / _POINT_ERROR**2),
                      float(np.sqrt(off.sum() / max(len(rows) * size.sum(), 1e-30))))


def better_frames(found: dict[str, _Explained]) -> list[str]:
    """Frames that explain a pull much better than as it is stated, the best first; none if that
    is as good."""
    if not found:
        return []
    order = sorted(found, key=lambda frame: found[frame].chi_squared)
    best = found[order[0]].chi_squared
    if found[AS_POSES].chi_squared < best + _MUCH_BETTER:
        return []
    return [frame for frame in order if found[frame].chi_squared < best + _AS_WELL]


def require_bent_as_pulled(pull: Pull, skeleton: Skeleton, known: Frames,
                           ) -> tuple[float | None, str | None]:
    """Return the modulus [Pa] that force and motion imply, if they have a direction; and a warning
    if it is no plant's, or the force too small. InputError, with the likely frames, if another
    explains force or rotations much better."""
    beam = Cantilever.of(skeleton, np.array(pull.entry.grasp.point_m))
    if beam is None:
        return None, None
    _require_radians(pull, beam)
    poses, _, change, noise = _blocks(pull)
    if len(poses) and change < _NOISES * noise:
        return None, (
            f"{pull.name}: the force changes by {change:.2g} N, with a noise of {noise:.2g} N. "
            "That does not tell whether its frame and sign are right. Pull farther, or use a finer "
            "sensor.")
    found = explained_forces(pull, beam, known)
    others = better_frames(found)
    # A force with the opposite sign is found by its work.
    if others and others[0] != "-x,-y,-z":
        raise InputError(
            f"{pull.name}: the force as recorded does not bend the branch the way the gripper "
            f"moved: {_percent(found[AS_POSES])} of it are unexplained, and "
            f"{_percent(found[others[0]])} in the frame {others[0]}.",
            "The force is likely given in another frame than the gripper's poses"
            + (f" ({' or '.join(others[:4])} fit alike)." if len(others) > 1 else "."),
            Text.joined(" or ", [Option("force_frame", frame) for frame in others[:4]]),
            " would fit. If the frame is right, state ", Option("force_frame", AS_POSES),
            ", and check the grasp point and the sensor's drift.")
    young = found[AS_POSES].young if found and not others else None
    return young, None if young is None else force_unit_suspicion(young)


def require_followed(pull: Pull, skeleton: Skeleton, known: Frames, *, is_placed: bool = False,
                     is_timed: bool = False) -> None:
    """Refuse points that do not go where, or when, the gripper takes the branch, but do in another
    frame, or with another offset of the clocks; ``is_placed`` and ``is_timed``: not these."""
    beam, seen = Cantilever.of(skeleton, np.array(pull.entry.grasp.point_m)), pull.observations
    if (beam is None or seen is None or pull.entry.motion != "quasi_static"
            or np.linalg.norm(np.ptp(pull.poses[:, :3], axis=0)) < 5e-3):
        return
    whole = min(np.ptp(pull.times), np.ptp(seen.times), 20.0)
    at = np.linspace(-0.5, 0.5, 81) * whole
    lags = [explained_points(pull, beam, np.eye(3), float(lag)) for lag in at]
    costs = np.array([each.chi_squared for each in lags])
    frames = {AS_POSES: lags[40]} | ({} if is_placed else {
        frame: explained_points(pull, beam, turn, 0.0) for frame, turn in (
            {"scan": known.scan} | AXES).items() if frame != "x,y,z"})
    least = np.inf if is_timed else costs.min()
    others = better_frames(frames)
    if others and frames[others[0]].chi_squared < least + _AS_WELL:
        _refuse_frame(pull.name, frames, others, known)
    if costs[40] > least + _MUCH_BETTER and (
            lags[int(costs.argmin())].misfit < _FOLLOWS * lags[40].misfit):
        fit = at[costs < least + _AS_WELL] + pull.entry.time_offset_s
        raise InputError(
            f"{pull.name}: the points do not follow the gripper with the clocks as they are "
            f"({_percent(lags[40])} off), but do with other offsets "
            f"({_percent(lags[int(costs.argmin())])} off, {fit.min():.2f} to {fit.max():.2f} s).",
            "The two tables likely have clocks of their own.",
            Option("time_offset", float(f"{np.mean(fit):.3g}")), " would fit. If the clocks are "
            "one, state ", Option("time_offset", 0.0), ".")


def _refuse_frame(name: str, found: dict[str, _Explained], others: list[str], known: Frames,
                  ) -> None:
    spin = AXES.get(others[0], known.scan)
    raise InputError(
        f"{name}: the observed points do not go where the gripper takes the branch. They are "
        f"{_percent(found[AS_POSES])} off, and {_percent(found[others[0]])} with the axes "
        f"{', '.join(others[:3])}.", "Points and gripper are in different frames, or axes are "
        "exchanged in one of the tables.", *(
            ("State the frame of the points, which would fit (", Option("marker_frame", tuple(
                float(f"{x:.6g}") for x in (0, 0, 0, *rotation_vector(spin)))), ")")
            if np.linalg.det(spin) > 0 else
            (f"Exchange the titles of the points' columns: x, y, z are {others[0]}",)),
        "; or that of the gripper (", Option("frame_pose", (0,) * 6), "). If all is right, state ",
        Option("marker_frame", (0,) * 6), ".")


def _percent(found: _Explained) -> str:
    return f"{100 * min(found.misfit, 9.99):.0f} %"


def _require_radians(pull: Pull, beam: Cantilever) -> None:
    """Refuse rotations that follow those of the branch, but are some 57 times as large."""
    rows = np.linspace(0, len(pull.poses) - 1, 60).astype(int)
    turned, expected = (each - each.mean(axis=0) for each in (
        pull.poses[rows, 3:], beam.bent(pull.poses[rows, :3])[0][:, -1]))
    size = float(np.sum(expected**2))
    ratio = float(np.sum(turned * expected)) / max(size, 1e-12)
    if _DEGREES[0] < ratio < _DEGREES[1] and np.sum((turned - ratio * expected)**2) < 0.2 * np.sum(
            turned**2):
        raise InputError(f"{pull.name}: the gripper turns {ratio:.0f} times as far as the branch "
                         "does where it holds it.", "The rotation vector is likely in degrees.",
                         "Name the unit in the titles: rx_deg, ry_deg, rz_deg.")


def require_named_in_order(names: list[str], first: np.ndarray, points: np.ndarray, name: str,
                           ) -> None:
    """Refuse markers [m, 3] that lie at control points [m, 3], but in another order."""
    if first.shape != points.shape or not np.isfinite(first).all() or len(points) < 2:
        return
    away = np.linalg.norm(first[:, None] - points, axis=2)**2
    order = scipy.optimize.linear_sum_assignment(away)[1]
    nearest = np.min(np.linalg.norm(points[:, None] - points, axis=2) + np.diag(
        np.full(len(points), np.inf)))
    if np.trace(away) > max(4 * away[np.arange(len(order)), order].sum(), nearest**2):
        likely = ", ".join(names[k] for k in np.argsort(order))
        raise InputError(f"{name}: the markers {', '.join(names)} are not at the control points in "
                         "this order, from the base outwards.",
                         f"They fit in the order {likely}, so their names are likely exchanged.",
                         "Exchange their columns' titles. Or state that each marker stays where it "
                         "is at first (", Option("marker_frame", (0,) * 6), ").")


def slips_of(pull: Pull, skeleton: Skeleton) -> list[str]:
    """What these checks refuse, of a pull in a branch folder."""
    known = Frames(np.eye(3), np.eye(3))
    try:
        require_bent_as_pulled(pull, skeleton, known)
        require_followed(pull, skeleton, known, is_timed=True)
    except InputError as error:
        return [Text(error.seen, " ", error.why, " Import it again: ", error.fix)]
    return []
