"""Rigid transforms of arrays: rotations, poses, their interpolation, the rigid motion that fits.

A rotation is a vector [3] in rad or a matrix [3, 3]; a pose [6] is a position in m and a rotation
vector; a frame [4, 4] is its homogeneous matrix. Loops at a controller's rate use
:mod:`limber.geometry.rigid_kernels`, which takes one at a time.
"""

import numpy as np
import scipy


def _rotations(vectors: np.ndarray) -> "scipy.spatial.transform.Rotation":
    # A copy: scipy does not accept read-only arrays.
    return scipy.spatial.transform.Rotation.from_rotvec(np.array(vectors, float))


def any_normal(directions: np.ndarray) -> np.ndarray:
    """Return a unit vector orthogonal to each direction [..., 3], the same for the same one."""
    normal = np.cross(directions, np.eye(3)[np.abs(directions).argmin(axis=-1)])
    return normal / np.linalg.norm(normal, axis=-1, keepdims=True)


def rotation_matrix(vectors: np.ndarray) -> np.ndarray:
    """Return the matrices of rotation vectors [rad], shape [3] or [n, 3]."""
    return _rotations(vectors).as_matrix()


def rotation_vector(matrices: np.ndarray) -> np.ndarray:
    """Return the rotation vectors [rad] of rotation matrices, shape [3, 3] or [n, 3, 3]."""
    return scipy.spatial.transform.Rotation.from_matrix(matrices).as_rotvec()


def rotation_angle(matrices: np.ndarray) -> np.ndarray:
    """Return the angles [rad] of rotation matrices, shape [3, 3] or [n, 3, 3]."""
    return scipy.spatial.transform.Rotation.from_matrix(matrices).magnitude()


def rotated(vectors: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return points [3] or [n, 3] rotated by one rotation vector [rad], or each by its own."""
    return _rotations(vectors).apply(points)


def composed(second: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Return the rotation vectors [rad] of ``first`` followed by ``second``, in fixed axes."""
    return (_rotations(second) * _rotations(first)).as_rotvec()


def turn_between(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the relative rotation vectors [rad] from some rotation vectors to others."""
    return (_rotations(second) * _rotations(first).inv()).as_rotvec()


def angle_between(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the angles [rad] between rotation vectors, shape [3] or [n, 3] each."""
    return (_rotations(second) * _rotations(first).inv()).magnitude()


def pose_between(first: np.ndarray, second: np.ndarray, part: float | np.ndarray) -> np.ndarray:
    """Return poses at fraction ``part`` (one, or [n]) of a straight line and the shortest rotation
    between poses [6] or [n, 6]."""
    part = np.asarray(part)[..., None]
    turns = part * turn_between(first[..., 3:], second[..., 3:])
    return np.concatenate([first[..., :3] + part * (second[..., :3] - first[..., :3]),
                           composed(turns, first[..., 3:])], axis=-1)


def rotations_at(times: np.ndarray, vectors: np.ndarray, query: np.ndarray) -> np.ndarray:
    """Return rotation vectors [rad] at ``query`` times [m] within ascending ``times`` [n], along
    the shortest rotations between ``vectors`` [n, 3]."""
    return scipy.spatial.transform.Slerp(times, _rotations(vectors))(query).as_rotvec()


def poses_at(times: np.ndarray, poses: np.ndarray, query: np.ndarray) -> np.ndarray:
    """Return poses [m, 6] at ``query`` times; arguments as for :func:`rotations_at`."""
    positions = np.column_stack([np.interp(query, times, axis) for axis in poses[:, :3].T])
    return np.hstack([positions, rotations_at(times, poses[:, 3:], query)])


def curve_through(along: np.ndarray, points: np.ndarray, query: np.ndarray) -> np.ndarray:
    """Return points [m, 3] at ``query`` [m] of a curve through ``points`` [n, 3] at lengths
    ``along`` [n]: Akima's, which hardly overshoots. A straight line between two points runs inside
    of it, where a branch that is stiff along itself pulls more than at either."""
    passed = np.r_[True, np.diff(along) > 1e-9]
    if passed.sum() < 3:
        return np.column_stack([np.interp(query, along, axis) for axis in points.T])
    return scipy.interpolate.Akima1DInterpolator(along[passed], points[passed], method="makima")(
        np.clip(query, along[0], along[passed][-1]))


def matrices(poses: np.ndarray) -> np.ndarray:
    """Return the frames [..., 4, 4] of poses [..., 6]."""
    poses = np.asarray(poses, float)
    frames = np.zeros((*poses.shape[:-1], 4, 4))
    turns = rotation_matrix(poses[..., 3:].reshape(-1, 3))
    frames[..., :3, :3] = turns.reshape(*poses.shape[:-1], 3, 3)
    frames[..., :3, 3] = poses[..., :3]
    frames[..., 3, 3] = 1.0
    return frames


def pose_vectors(frames: np.ndarray) -> np.ndarray:
    """Return the poses [..., 6] of frames [..., 4, 4]."""
    frames = np.asarray(frames, float)
    turns = rotation_vector(frames[..., :3, :3].reshape(-1, 3, 3))
    return np.concatenate([frames[..., :3, 3], turns.reshape(*frames.shape[:-2], 3)], axis=-1)


def inverted(frames: np.ndarray) -> np.ndarray:
    """Return the inverses of frames [..., 4, 4]."""
    frames = np.asarray(frames, float)
    result = np.zeros_like(frames)
    turned = np.swapaxes(frames[..., :3, :3], -1, -2)
    result[..., :3, :3] = turned
    result[..., :3, 3] = -np.einsum("...ij,...j->...i", turned, frames[..., :3, 3])
    result[..., 3, 3] = 1.0
    return result


def closest_rotation(matrix: np.ndarray) -> np.ndarray:
    """Return the rotation nearest to a matrix [3, 3]; never a reflection."""
    left, _, right = np.linalg.svd(matrix)
    return left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right


def rigid_fit(points: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation [3, 3] and translation [3] that map ``points`` onto ``target`` (Kabsch), [n, 3]."""
    centre, goal = points.mean(axis=0), target.mean(axis=0)
    turn = closest_rotation((target - goal).T @ (points - centre))
    return turn, goal - turn @ centre


def principal_axes(points: np.ndarray) -> np.ndarray:
    """Return unit vectors of the principal axes of points [n, d] as rows, the largest spread first,
    their signs arbitrary."""
    return np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2]


def spreads(points: np.ndarray) -> np.ndarray:
    """Root mean squares of points [n, 3] along their principal axes, descending, shape [3]."""
    away = points - points.mean(axis=0)
    return np.linalg.svd(away, compute_uv=False) / np.sqrt(len(points))
