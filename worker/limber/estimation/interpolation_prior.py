"""Interpolation prior: Young's modulus between the control points is uncertain.

The paper uses inverse-distance weights of the moduli. A modulus that is linear between the control
points, decreases monotonically, or differs in side branches explains a pull equally well, with
other moduli at the control points: by tens of percent if neighbours differ severalfold. The field
is therefore a mixture of the paper's field and one that is linear in its logarithm, with bumps
between the control points and beyond the outer ones. Mixture and bumps are unknowns in addition to
the moduli: the pull determines them, or they widen the intervals. Bumps are larger the more the
neighbouring moduli differ.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from limber.core.not_none import present
from limber.estimation.parameters import Values
from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.tets.tet_mesh import TetMesh

MIXTURE = (0.5, 0.5)
"""Mean and deviation of the fraction of the log-linear field in the mixture."""
BUMP_BETWEEN, BUMP_BEYOND, BUMP_OF_ORDER = 0.1, 0.3, 0.3
"""Deviations of log E from the mixture: halfway between control points, at base and tip beyond the
outer ones, and of side branches from the point they grow from. For a branch with constant log E.
"""
STEP_BETWEEN, STEP_BEYOND = 0.15, 0.3
"""The same as a fraction of the adjacent step of log E, which is added to those. A cubic between
two control points differs from the straight line halfway by an eighth of the difference of its
slopes at both. Slopes of 0 to 3 times the straight one's keep it monotone (Fritsch and Carlson
1980); if all are equally likely, the deviation is 3/8 sqrt(2/12) = 0.153. Beyond the outer control
points it may stop at once or continue for the length of a step: the uniform deviation, sqrt(1/12) =
0.29.
"""


@dataclass(frozen=True)
class YoungField:
    """Young's modulus of the tetrahedra from that at the control points.

    Attributes:
        weights: The paper's inverse-distance weights, shape [tet_count, K].
        straight: Weights of the logarithms in the log-linear field, shape [tet_count, K]; None: the
            field is the paper's, without further unknowns.
        bumps: Effect of each further unknown on log E, 1 at most, shape [tet_count, B].
        widths: Deviations of these changes if all moduli are the same, shape [B].
        steps: Increase of them by a change of log E at the control points, shape [B, K].
        names: Names of the mixture and the bumps, B + 1; empty without ``straight``.
    """

    weights: np.ndarray
    straight: np.ndarray | None = None
    bumps: np.ndarray | None = None
    widths: np.ndarray | None = None
    steps: np.ndarray | None = None
    names: tuple[str, ...] = ()

    def young(self, values: Values) -> np.ndarray:
        """Young's modulus of all tetrahedra [Pa], shape [tet_count]."""
        plain = self.weights @ values.young
        if self.straight is None:
            return plain
        form = self._form(values)
        part = self._part(form)
        sizes, _ = self._sizes(values)
        return np.exp((1 - part) * np.log(plain) + part * (self.straight @ np.log(values.young))
                      + self.bumps @ (sizes * form[1:]))

    def shares(self, values: Values, extra: tuple[str, ...]) -> np.ndarray:
        """Derivative of log E of the tetrahedra to log E at the control points and, if they are
        among the ``extra`` parameters, to the further unknowns, shape [K + B + 1, tet_count].
        """
        plain = self.weights @ values.young
        shares = (self.weights * values.young).T / plain
        if self.straight is None:
            return shares
        form = self._form(values)
        part = self._part(form)
        sizes, by_young = self._sizes(values)
        shares = ((1 - part) * shares + part * self.straight.T
                  + (self.bumps @ (form[1:, None] * by_young)).T)
        if self.names[0] not in extra:
            return shares
        deviation = self.straight @ np.log(values.young) - np.log(plain)
        return np.vstack([shares, MIXTURE[1] * deviation, (self.bumps * sizes).T])

    def deviations(self, values: Values) -> np.ndarray:
        """Change of log E by each bump, with these moduli, shape [B]."""
        return np.zeros(0) if self.straight is None else self._sizes(values)[0]

    def growth(self, values: Values) -> np.ndarray:
        """Derivative of the logarithm of each further unknown's effect on the field to log E at the
        control points, shape [B + 1, K].
        """
        plain = self.weights @ values.young
        deviation = self.straight @ np.log(values.young) - np.log(plain)
        by_young = self.straight - self.weights * values.young / plain[:, None]
        sizes, sizes_by_young = self._sizes(values)
        # For a uniform branch both fields of the mixture are the same.
        return np.vstack([deviation @ by_young / max(float(deviation @ deviation), 1e-12),
                          sizes_by_young / sizes[:, None]])

    def same_at_any_step(self) -> "YoungField":
        """Return the field with the bumps of a uniform branch, as in older estimates."""
        return self if self.straight is None else replace(self, steps=np.zeros_like(self.steps))

    def _sizes(self, values: Values) -> tuple[np.ndarray, np.ndarray]:
        """Deviations of the bumps [B], and their derivative to log E at the control points [B, K].
        """
        step = self.steps @ np.log(values.young)
        sizes = np.hypot(present(self.widths, "bump of the field"), step)
        return sizes, (step / sizes)[:, None] * self.steps

    def _form(self, values: Values) -> np.ndarray:
        return np.array(values.form) if len(values.form) else np.zeros(len(self.names))

    def _part(self, form: np.ndarray) -> float:
        return MIXTURE[0] + MIXTURE[1] * float(form[0])


def open_field(mesh: TetMesh, skeleton: Skeleton, weights: np.ndarray,
               fractions: tuple[float, ...]) -> YoungField:
    """Return the field with an unknown interpolation; for a single modulus, the uniform one.

    Args:
        fractions: Positions of the control points on the main path, ascending, shape [K].
    """
    positions = np.asarray(fractions, float)
    if len(positions) < 2 or np.any(np.diff(positions) <= 0):
        return YoungField(weights)
    along, is_side = _element_positions(mesh, skeleton)
    straight = _hats(along, positions)
    halfway = (positions[1:] + positions[:-1]) / 2
    stations = np.sort(np.r_[positions, halfway, *([0.0] if positions[0] > 0 else []),
                             *([1.0] if positions[-1] < 1 else [])])
    hats = _hats(along, stations)
    names, bumps, widths, steps = ["form"], [], [], []
    for number, station in enumerate(stations):
        if np.any(np.isclose(station, positions)):
            continue
        inside = positions[0] < station < positions[-1]
        names.append(f"form at {station:.2g}")
        bumps.append(hats[:, number])
        widths.append(BUMP_BETWEEN if inside else BUMP_BEYOND)
        beside = int(np.clip(np.searchsorted(positions, station), 1, len(positions) - 1))
        steps.append((STEP_BETWEEN if inside else STEP_BEYOND) * (
            np.eye(len(positions))[beside] - np.eye(len(positions))[beside - 1]))
    if is_side.any():
        names.append("form of side branches")
        bumps.append(is_side.astype(float))
        widths.append(BUMP_OF_ORDER)
        steps.append(np.zeros(len(positions)))
    return YoungField(weights, straight, np.column_stack(bumps), np.array(widths),
                      np.array(steps), tuple(names))


def _element_positions(mesh: TetMesh, skeleton: Skeleton) -> tuple[np.ndarray, np.ndarray]:
    """Position of each tetrahedron on the main path (0 to 1), and whether it is on a side branch.
    """
    path = np.asarray(skeleton.main_path())
    on_path = np.zeros(len(skeleton.nodes), bool)
    on_path[path] = True
    # A side branch has the position of its base.
    root = np.arange(len(skeleton.nodes))
    for node in range(len(root)):
        climbed = node
        while not on_path[climbed] and skeleton.parent[climbed] >= 0:
            climbed = skeleton.parent[climbed]
        root[node] = climbed
    arc = skeleton.arc_length
    middles, positions = [skeleton.nodes], [arc[root] / arc[path[-1]]]
    child = np.flatnonzero(skeleton.parent >= 0)
    parent = skeleton.parent[child]
    for share in (0.25, 0.5, 0.75):
        middles.append((1 - share) * skeleton.nodes[parent] + share * skeleton.nodes[child])
        positions.append((1 - share) * positions[0][parent] + share * positions[0][child])
    side = np.concatenate([~on_path, *3 * [~on_path[child]]])
    nearest = cKDTree(np.vstack(middles)).query(mesh.centroids)[1]
    return np.clip(np.concatenate(positions)[nearest], 0.0, 1.0), side[nearest]


def _hats(along: np.ndarray, stations: np.ndarray) -> np.ndarray:
    """Weights of linear interpolation between stations, constant beyond, shape [n, stations]."""
    return np.column_stack([np.interp(along, stations, row) for row in np.eye(len(stations))])
