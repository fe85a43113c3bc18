"""Compiled equilibria of a rod: elements, a banded factorisation, Newton's iteration, folds.

Sections have positions ``r`` [N + 1, 3] and unit quaternions ``q`` [N + 1, 4] (w first); the first
is clamped. With the middle's rotation R of an element, its rest vector d and its stiffness K,

    e = (R^T (r2 - r1) - d,  log(R1^T R2)),      energy = e . K e / 2 + w . e,

``w`` carries the weight in the scanned shape (Crisfield and Jelenic 1999 for e, which no rigid
motion changes). Unknowns are spatial rotation and displacement, six a section. A ``rod`` is the
tuple of d [N, 3], K [N, 6, 6], w [N, 6], loads [N + 1, 3] and their arms [N + 1, 3].
"""

import numpy as np

from limber.core.numerics.compiled import compiled
from limber.core.numerics.rigid_kernels import crossed

BAND = 12
"""Entries of a row of the lower band: column ``j`` of row ``i`` is at ``11 - (i - j)``."""
_ITERATIONS = 14
_SMALL = 1e-7  # last step of Newton's iteration, in rad and lengths; its square is left
_LONGEST_TURN = 0.7  # [rad] in one iteration


@compiled
def turned(q: np.ndarray) -> np.ndarray:
    """Return the matrix of a quaternion of any length."""
    w, x, y, z = q
    n = w * w + x * x + y * y + z * z
    out = np.empty((3, 3))
    out[0, 0] = (w * w + x * x - y * y - z * z) / n
    out[1, 1] = (w * w - x * x + y * y - z * z) / n
    out[2, 2] = (w * w - x * x - y * y + z * z) / n
    out[0, 1], out[1, 0] = 2 * (x * y - w * z) / n, 2 * (x * y + w * z) / n
    out[0, 2], out[2, 0] = 2 * (x * z + w * y) / n, 2 * (x * z - w * y) / n
    out[1, 2], out[2, 1] = 2 * (y * z - w * x) / n, 2 * (y * z + w * x) / n
    return out


@compiled
def _dot(a: np.ndarray, b: np.ndarray) -> float:
    total = 0.0
    for i in range(len(a)):
        total += a[i] * b[i]
    return total


@compiled
def _hat(a: np.ndarray) -> np.ndarray:
    out = np.zeros((3, 3))
    out[0, 1], out[0, 2], out[1, 2] = -a[2], a[1], -a[0]
    out[1, 0], out[2, 0], out[2, 1] = a[2], -a[1], a[0]
    return out


@compiled
def _product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return a b; BLAS takes longer for such small ones."""
    out = np.zeros((a.shape[0], b.shape[1]))
    for i in range(a.shape[0]):
        for k in range(a.shape[1]):
            for j in range(b.shape[1]):
                out[i, j] += a[i, k] * b[k, j]
    return out


@compiled
def _slope(f: np.ndarray, x: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the derivative of x . R(q) f by q, [4], and that value."""
    n, fx, c = _dot(q, q), _dot(f, x), crossed(f, x)
    fv = f[0] * q[1] + f[1] * q[2] + f[2] * q[3]
    xv = x[0] * q[1] + x[1] * q[2] + x[2] * q[3]
    out = np.empty(4)
    out[0] = fx * q[0] + c[0] * q[1] + c[1] * q[2] + c[2] * q[3]
    for i in range(3):
        out[1 + i] = c[i] * q[0] - fx * q[1 + i] + f[i] * xv + x[i] * fv
    value = _dot(out, q) / n
    for i in range(4):
        out[i] = 2 * (out[i] - value * q[i]) / n
    return out, value


@compiled
def _curvature(f: np.ndarray, x: np.ndarray, q: np.ndarray, slope: np.ndarray, value: float,
               ) -> np.ndarray:
    """Return the second derivative of x . R(q) f by q, [4, 4]."""
    n, fx, c = _dot(q, q), _dot(f, x), crossed(f, x)
    out = np.empty((4, 4))
    out[0, 0] = fx
    for i in range(3):
        out[0, 1 + i] = out[1 + i, 0] = c[i]
        for j in range(3):
            out[1 + i, 1 + j] = f[i] * x[j] + x[i] * f[j]
        out[1 + i, 1 + i] -= fx
    for i in range(4):
        for j in range(4):
            out[i, j] = 2 * (out[i, j] - slope[i] * q[j] - q[i] * slope[j]) / n
        out[i, i] -= 2 * value / n
    return out


@compiled
def _arcsine(u: float) -> tuple[float, float, float]:
    """Return asin(sqrt u) / sqrt u and its first two derivatives."""
    if u < 1e-2:
        return (1 + u * (1 / 6 + u * (3 / 40 + u * (5 / 112 + u * (35 / 1152 + u * 63 / 2816)))),
                1 / 6 + u * (3 / 20 + u * (15 / 112 + u * (35 / 288 + u * 315 / 2816))),
                3 / 20 + u * (15 / 56 + u * (35 / 96 + u * 315 / 704)))
    value, steep = np.arcsin(np.sqrt(u)) / np.sqrt(u), 1 / np.sqrt(1 - u)
    slope = (steep - value) / (2 * u)
    return value, slope, (0.5 * steep**3 - 3 * slope) / (2 * u)


@compiled
def _turning(q: np.ndarray) -> np.ndarray:
    """Return the change of a quaternion with a spatial rotation, [4, 3]."""
    out = np.empty((4, 3))
    out[0, 0], out[0, 1], out[0, 2] = -q[1], -q[2], -q[3]
    out[1, 0], out[1, 1], out[1, 2] = q[0], q[3], -q[2]
    out[2, 0], out[2, 1], out[2, 2] = -q[3], q[0], q[1]
    out[3, 0], out[3, 1], out[3, 2] = q[2], -q[1], q[0]
    return 0.5 * out


@compiled
def _element(r1: np.ndarray, q1: np.ndarray, r2: np.ndarray, q2: np.ndarray, rest: np.ndarray,
             stiff: np.ndarray, carried: np.ndarray, curved: bool, grad: np.ndarray,
             hess: np.ndarray,
             ) -> tuple[float, np.ndarray]:
    """Return an element's energy and stress less ``carried`` [6]; write its gradient [12] and, if
    ``curved``, its second derivative [12, 12] to rotation and position of both ends."""
    along, middle = r2 - r1, q1 + q2
    R, R1 = turned(middle), turned(q1)
    v = np.empty(3)
    v[0] = q1[0] * q2[1] - q2[0] * q1[1] - q1[2] * q2[3] + q1[3] * q2[2]
    v[1] = q1[0] * q2[2] - q2[0] * q1[2] - q1[3] * q2[1] + q1[1] * q2[3]
    v[2] = q1[0] * q2[3] - q2[0] * q1[3] - q1[1] * q2[2] + q1[2] * q2[1]
    cosine = _dot(q1, q2)
    g, g1, g2 = _arcsine(_dot(v, v))
    strain, elastic = np.empty(6), np.zeros(6)
    first, second = _turning(q1), _turning(q2)
    B = np.zeros((6, 12))
    for i in range(3):
        unit = np.zeros(3)
        unit[i] = 1.0
        row, value = _slope(unit, along, middle)
        strain[i], strain[3 + i] = value - rest[i], 2 * g * v[i]
        for j in range(3):
            for a in range(4):
                B[i, j] += row[a] * first[a, j]
                B[i, 6 + j] += row[a] * second[a, j]
            B[i, 3 + j], B[i, 9 + j] = -R[j, i], R[j, i]
    energy = 0.0
    for i in range(6):
        for j in range(6):
            elastic[i] += stiff[i, j] * strain[j]
        energy += (0.5 * elastic[i] + carried[i]) * strain[i]
    stress = elastic + carried
    force, moment = stress[:3], stress[3:]
    by_turn, by_v = -0.5 * _hat(v), np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            by_v[i, j] = 4 * g1 * v[i] * v[j]
        by_v[i, i] += 2 * g
        by_turn[i, i] += 0.5 * cosine
    turn = _product(_product(by_v, by_turn), R1.T)
    B[3:, :3], B[3:, 6:9] = -turn, turn
    for j in range(12):
        grad[j] = _dot(B[:, j], stress)
    if not curved:
        return energy, elastic
    hess[:] = _product(B.T, _product(stiff, B))
    # What the stress adds to the second derivative: by the middle's rotation ...
    slope, value = _slope(force, along, middle)
    H = _curvature(force, along, middle, slope, value)
    H1, H2 = _product(H, first), _product(H, second)
    one, both, two = _product(first.T, H1), _product(first.T, H2), _product(second.T, H2)
    # ... and by the relative rotation.
    mv, by_moment, V = _dot(moment, v), np.empty(3), np.empty((3, 3))
    for i in range(3):
        by_moment[i] = 2 * g * moment[i] + 4 * g1 * mv * v[i]
        for j in range(3):
            V[i, j] = 4 * g1 * (moment[i] * v[j] + v[i] * moment[j]) + 8 * g2 * mv * v[i] * v[j]
        V[i, i] += 4 * g1 * mv
    V = _product(by_turn.T, _product(V, by_turn))
    for i in range(3):
        V[i, i] -= 0.25 * _dot(by_moment, v)
    V = _product(R1, _product(V, R1.T))
    twist, lever = crossed(v, by_moment) + cosine * by_moment, np.zeros(3)
    for i in range(3):
        lever[i] = 0.25 * _dot(R1[i], twist)
    spin = _hat(lever)
    for i in range(3):
        one[i, i] -= 0.25 * _dot(slope, q1)
        two[i, i] -= 0.25 * _dot(slope, q2)
        unit = np.zeros(3)
        unit[i] = 1.0
        row, _ = _slope(force, unit, middle)
        for j in range(3):
            hess[i, j] += one[i, j] + V[i, j]
            hess[6 + i, 6 + j] += two[i, j] + V[i, j]
            cross = both[i, j] - V[i, j] + spin[i, j]
            hess[i, 6 + j] += cross
            hess[6 + j, i] += cross
            near, far = _dot(row, first[:, j]), _dot(row, second[:, j])
            hess[j, 3 + i] -= near
            hess[3 + i, j] -= near
            hess[j, 9 + i] += near
            hess[9 + i, j] += near
            hess[6 + j, 3 + i] -= far
            hess[3 + i, 6 + j] -= far
            hess[6 + j, 9 + i] += far
            hess[9 + i, 6 + j] += far
    return energy, elastic


@compiled
def assembled(r: np.ndarray, q: np.ndarray, rod: tuple, curved: bool, grad: np.ndarray,
              band: np.ndarray, stress: np.ndarray,
              ) -> float:
    """Return the energy; write its gradient [6 N], lower band [6 N, 12] and stresses [N, 6]."""
    rest, stiff, carried, loads, arms = rod
    energy = 0.0
    grad[:], band[:] = 0.0, 0.0
    g, h = np.empty(12), np.empty((12, 12))
    for k in range(len(rest)):
        own, stress[k] = _element(r[k], q[k], r[k + 1], q[k + 1], rest[k], stiff[k], carried[k],
                                  curved, g, h)
        energy += own
        begin = 6 * (k - 1)
        for a in range(0 if k else 6, 12):
            grad[begin + a] += g[a]
            if curved:
                for b in range(0 if k else 6, a + 1):
                    band[begin + a, 11 - (a - b)] += h[a, b]
    for k in range(len(rest)):
        force, arm, begin = loads[k + 1], np.zeros(3), 6 * k
        R = turned(q[k + 1])
        for i in range(3):
            arm[i] = _dot(R[i], arms[k + 1])
        moment, work = crossed(arm, force), _dot(force, arm)
        energy -= _dot(force, r[k + 1]) + work
        for i in range(3):
            grad[begin + i] -= moment[i]
            grad[begin + 3 + i] -= force[i]
            for j in range(i + 1):
                band[begin + i, 11 - (i - j)] -= 0.5 * (force[i] * arm[j] + arm[i] * force[j])
            band[begin + i, 11] += work
    return energy


@compiled
def _factorised(band: np.ndarray, size: int) -> int:
    """Factorise the leading ``size`` rows in place, L D L^T; return how many pivots are negative:
    as many as the matrix has negative eigenvalues."""
    negative, row = 0, np.empty(BAND)
    for i in range(size):
        low, pivot = max(0, i - 11), band[i, 11]
        for j in range(low, i):
            value = band[i, 11 - (i - j)]
            for k in range(max(low, j - 11), j):
                value -= row[k - low] * band[j, 11 - (j - k)]
            row[j - low] = value
        for j in range(low, i):
            band[i, 11 - (i - j)] = row[j - low] / band[j, 11]
            pivot -= row[j - low] * band[i, 11 - (i - j)]
        band[i, 11] = pivot
        negative += pivot < 0.0
    return negative


@compiled
def _solve(band: np.ndarray, size: int, right: np.ndarray) -> None:
    """Replace ``right`` by the solution for the leading ``size`` rows."""
    for i in range(size):
        for j in range(max(0, i - 11), i):
            right[i] -= band[i, 11 - (i - j)] * right[j]
    for i in range(size):
        right[i] /= band[i, 11]
    for i in range(size - 1, -1, -1):
        for j in range(max(0, i - 11), i):
            right[j] -= band[i, 11 - (i - j)] * right[i]


@compiled
def _move(r: np.ndarray, q: np.ndarray, step: np.ndarray, part: float) -> None:
    for k in range(1, len(r)):
        begin = 6 * (k - 1)
        turn = part * step[begin:begin + 3]
        angle = np.sqrt(_dot(turn, turn))
        half = 0.5 - angle * angle / 48 if angle < 1e-3 else np.sin(0.5 * angle) / angle
        w, x, y, z = q[k]
        c, a, b, d = np.cos(0.5 * angle), half * turn[0], half * turn[1], half * turn[2]
        q[k, 0], q[k, 1] = c * w - a * x - b * y - d * z, c * x + a * w + b * z - d * y
        q[k, 2], q[k, 3] = c * y + b * w + d * x - a * z, c * z + d * w + a * y - b * x
        q[k] /= np.sqrt(_dot(q[k], q[k]))
        for i in range(3):
            r[k, i] += part * step[begin + 3 + i]


@compiled
def newton(r: np.ndarray, q: np.ndarray, rod: tuple, asked: np.ndarray, held: bool,
           ) -> tuple[bool, bool]:
    """Iterate with the end at the position ``asked`` [3] if ``held``, else under that force;
    whether it converged, and to a stable state."""
    whole = 6 * (len(r) - 1)
    size = whole - 3 if held else whole
    grad, band, stress = np.empty(whole), np.empty((whole, BAND)), np.empty((len(r) - 1, 6))
    length = np.sqrt(_dot(r[-1] - r[0], r[-1] - r[0]))
    for _ in range(_ITERATIONS):
        assembled(r, q, rod, True, grad, band, stress)
        step = -grad
        for i in range(3):
            step[whole - 3 + i] = asked[i] - (r[-1, i] if held else grad[whole - 3 + i])
        for i in range(whole - size):
            for j in range(size + i - 11, size):
                step[j] -= band[size + i, 11 - (size + i - j)] * step[size + i]
        negative, most = _factorised(band, size), 0.0
        _solve(band, size, step)
        for i in range(whole):
            most = max(most, np.abs(step[i]) / (1.0 if i % 6 < 3 else length))
        if not most < 1e3:
            return False, False
        _move(r, q, step, min(1.0, _LONGEST_TURN / max(most, 1e-12)))
        if most < _SMALL:
            return True, negative == 0
    return False, False


@compiled
def known_at(r: np.ndarray, q: np.ndarray, rod: tuple,
             ) -> tuple[float, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return energy, force on the end [3], stresses [N, 6], changes of the unknowns with the end's
    position [6 N, 3] and the end's stiffness [3, 3]."""
    whole = 6 * (len(r) - 1)
    size = whole - 3
    grad, band, stress = np.empty(whole), np.empty((whole, BAND)), np.empty((len(r) - 1, 6))
    energy = assembled(r, q, rod, True, grad, band, stress)
    last, changes, stiff = band[size:].copy(), np.zeros((whole, 3)), np.zeros((3, 3))
    _factorised(band, size)
    for i in range(3):
        right = np.zeros(whole)
        for j in range(size + i - 11, size):
            right[j] = -last[i, 11 - (size + i - j)]
        _solve(band, size, right)
        changes[:, i] = right
        changes[size + i, i] = 1.0
    for i in range(3):
        for j in range(3):
            for k in range(size + i - 11, size):
                stiff[i, j] += last[i, 11 - (size + i - k)] * changes[k, j]
            stiff[i, j] += last[max(i, j), 11 - np.abs(i - j)]
    return energy, grad[size:].copy(), stress, changes, stiff
