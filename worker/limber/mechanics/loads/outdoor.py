"""Effects of wind, snow, fruit and pruning on a branch: forces, masses and equilibrium."""

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import scipy
import scipy.sparse as sp
from scipy.spatial import cKDTree

from limber.core.errors import InputError
from limber.geometry.skeleton.skeleton import Skeleton
from limber.mechanics.added_masses import PointMass
from limber.mechanics.dynamics.motion import lowest_modes
from limber.mechanics.materials.materials import RayleighDamping
from limber.mechanics.model import BranchModel
from limber.mechanics.points import point_operator
from limber.mechanics.statics.result import StaticResult
from limber.mechanics.statics.solve import solve_static
from limber.mechanics.strain import carried_strain

# Gusts: how far turbulence moves a branch beyond its mean displacement.
#
# Turbulence is the same along the whole branch, which is shorter than a gust; across the wind it is
# left out. The branch responds with its lowest modes about its equilibrium in the mean wind; the
# rest of its response is quasi-static.
#
# Sources: A. G. Davenport, *Note on the distribution of the largest value of a random function with
# application to gust loading*, 1964; EN 1991-1-4:2005, annex B, for spectrum (B.1), peak factor
# (B.4), rate of crossings (B.5).

_GUST_MODES = 6
_LEAST_PEAK = 3.0
_LEAST_CROSSING = 0.08
_POINTS = 6000


@dataclass(frozen=True)
class Swaying:
    """The response of one displacement to a force that varies as a whole: modes' frequencies [k]
    [Hz], damping ratios with air, and shares of the static response (the rest is quasi-static)."""

    frequencies: np.ndarray
    damping: np.ndarray
    shares: np.ndarray

    def transfer(self, frequency: np.ndarray) -> np.ndarray:
        """Return the response over the static one at frequencies [Hz], complex."""
        ratio = np.asarray(frequency, float)[:, None] / self.frequencies
        modes = self.shares / (1 - ratio**2 + 2j * self.damping * ratio)
        return 1 - self.shares.sum() + modes.sum(axis=1)


@dataclass(frozen=True)
class GustResponse:
    """The effect of gusts on a mean load: ``factor`` times it bends the branch as far as the sway's
    peak. ``deviation`` is over the mean, ``peak_factor`` in deviations, ``crossing`` [Hz] upwards
    of the mean, ``dynamic`` over a quasi-static branch's deviation."""

    factor: float
    deviation: float
    peak_factor: float
    crossing: float
    dynamic: float


def swaying(model: BranchModel, displacement: np.ndarray, force: np.ndarray, tip: int,
            damping: RayleighDamping, air: np.ndarray | None = None) -> Swaying:
    """Return the response of node ``tip``, along its motion under the varying force [N], about an
    equilibrium. ``air`` is the aerodynamic force per velocity [N s/m], or a product with it."""
    tangent = model.equations(()).tangent(model, displacement)
    static = tangent.solve(force)[tip]
    direction = static / np.linalg.norm(static)
    modes = lowest_modes(model, _GUST_MODES, displacement)
    omega = 2 * np.pi * modes.frequencies
    loads = np.einsum("kni,ni->k", modes.shapes, force)
    shares = modes.shapes[:, tip] @ direction * loads / omega**2 / float(static @ direction)
    share = (damping.mass / omega + damping.stiffness * omega) / 2
    if air is not None:
        flat = modes.shapes.reshape(len(omega), -1)
        share = share + np.einsum("ki,ki->k", flat, (air @ flat.T).T) / (2 * omega)
    return Swaying(modes.frequencies, share, shares)


def wind_spectrum(frequency: np.ndarray, speed: float, length: float) -> np.ndarray:
    """Return the spectrum of the speed along the wind over its variance [1/Hz], EN 1991-1-4 B.1,
    with the turbulent length scale [m]."""
    slowness = length / speed
    return 6.8 * slowness / (1 + 10.2 * slowness * np.asarray(frequency)) ** (5 / 3)


def turbulent(sway: Swaying, speed: float, intensity: float, length: float, seconds: float,
              ) -> GustResponse:
    """Return the effect of turbulence of deviation ``intensity`` times the mean speed and length
    scale [m]; the peak is that expected in ``seconds``."""
    at = _frequencies(sway, speed / length)
    # The contribution of resonance; without it the branch follows all of the turbulence.
    added = np.abs(sway.transfer(at)) ** 2 - 1
    resonance = float(scipy.integrate.trapezoid(added * wind_spectrum(at, speed, length), at))
    power = max(1 + resonance, 0.0)
    crossing = max(float(sway.frequencies[0]) * np.sqrt(max(resonance, 0.0) / max(power, 1e-12)),
                   _LEAST_CROSSING)
    rare = np.sqrt(2 * np.log(max(crossing * seconds, math.e)))
    peak = max(rare + 0.6 / rare, _LEAST_PEAK)
    deviation = 2 * intensity * np.sqrt(power)
    return GustResponse(1 + peak * deviation, deviation, peak, crossing, float(np.sqrt(power)))


def recorded(sway: Swaying, times: np.ndarray, speeds: np.ndarray) -> GustResponse:
    """Return the effect of speeds [n] [m/s] along the mean wind at ascending times [s]; the load
    goes with the square of the speed."""
    step = float(np.median(np.diff(times)))
    even = np.arange(times[0], times[-1] + step / 2, step)
    load = np.interp(even, times, speeds)
    load = load * np.abs(load)
    load = load / load.mean() - 1
    size = 2 * len(load)
    answer = np.fft.irfft(np.fft.rfft(load, size) * sway.transfer(np.fft.rfftfreq(size, step)),
                          size)[:len(load)]
    deviation, quasi = float(answer.std()), float(load.std())
    peak = float(answer.max())
    upward = int(((answer[:-1] < 0) & (answer[1:] >= 0)).sum())
    return GustResponse(1 + peak, deviation, peak / max(deviation, 1e-300),
                        upward / (even[-1] - even[0]), deviation / max(quasi, 1e-300))


def _frequencies(sway: Swaying, corner: float) -> np.ndarray:
    """Frequencies [Hz], dense where the spectrum bends and where the branch resonates."""
    top = 20 * max(float(sway.frequencies[-1]), corner)
    wide = np.concatenate([[0.0], np.geomspace(1e-4 * min(corner, sway.frequencies[0]), top,
                                               _POINTS)])
    near = np.sinh(np.linspace(-8, 8, 801)) / np.sinh(8)
    peaks = [one * (1 + 0.5 * near) for one in sway.frequencies]
    return np.unique(np.concatenate([wide, *peaks]))


AIR_DENSITY = 1.225
"""Air density at sea level and 15 degrees [kg/m^3]."""
_STABILITY_MODES = 3
_REMAINS = 1e-3
"""Fraction of its density that cut-off wood keeps: without mass it would have no modes."""


@dataclass(frozen=True)
class Outdoors:
    """Loads besides the scanned weight: even wind [m/s], drag coefficient of a leafless cylinder,
    snow per area on the ground [kg/m^2], fruit, and cuts [m] that remove the part beyond."""

    wind: tuple[float, float, float] = (0.0, 0.0, 0.0)
    drag: float = 1.1
    snow: float = 0.0
    fruit: tuple[PointMass, ...] = ()
    cuts: tuple[tuple[float, float, float], ...] = field(default=())


@dataclass(frozen=True)
class Bent:
    """A branch in equilibrium: displacement from the hanging state [m], largest principal strain
    [tet_count] with that of its weight, and lowest frequencies [3] [Hz]."""

    displacement: np.ndarray
    strains: np.ndarray
    frequencies: np.ndarray


class LoadedOutdoors:
    """A branch with its loads; each is scaled by one fraction."""

    def __init__(self, model: BranchModel, skeleton: Skeleton, loads: Outdoors):
        """Compute forces and masses. InputError if a cut leaves nothing or is at the base, or the
        branch has no weight, so that fruit and snow would have none."""
        if (loads.fruit or loads.snow) and not model.gravity.any():
            raise InputError("The branch has no weight, so fruit and snow would have none either.",
                             "Its weight was switched off, or neglected because it could not carry "
                             "itself (see the warnings).",
                             "Start with gravity; check Young's modulus and the masses of targets.")
        self.skeleton = skeleton
        self.gone = _beyond(skeleton, loads.cuts)
        self.is_gone = self.gone[cKDTree(skeleton.nodes).query(model.mesh.centroids)[1]]
        self._plain = model
        start, end = skeleton.nodes[skeleton.parent[1:]], skeleton.nodes[1:]
        kept = ~self.gone[1:]
        start, end, radius = start[kept], end[kept], skeleton.radius[1:][kept]
        middle = (start + end) / 2
        self._masses = (*loads.fruit, *_snow(model, middle, end - start, radius, loads.snow))
        self.added_mass = sum(one.mass for one in self._masses)
        self._wind = np.zeros_like(model.mesh.nodes)
        self._loads, self._cylinders = loads, (middle, end - start, radius)
        if np.any(loads.wind):
            pushes = wind_forces(end - start, radius, np.array(loads.wind), loads.drag)
            self._wind += (point_operator(model.mesh, middle).T @ pushes.ravel()).reshape(-1, 3)
        self._forces = self._wind.copy()
        self.wind_force = self._wind.sum(axis=0)
        self._model = model if not self.is_gone.any() else model.with_parameters(
            density=np.where(self.is_gone, _REMAINS * model.density, model.density))
        # The scanned shape carries the weight of the cut-off part: without it, the branch springs
        # up.
        lost = model.mass_load - self._model.mass_load
        if model.prestress is not None:
            self._forces -= lost[:, None] * model.gravity
        self.cut_mass = float(lost.sum())

    @property
    def unloaded(self) -> BranchModel:
        """The branch as it hangs, without these loads."""
        return self._plain

    @property
    def wind(self) -> tuple[float, float, float]:
        """Velocity of the steady wind [m/s]."""
        return self._loads.wind

    @property
    def dead_forces(self) -> np.ndarray:
        """All loads as forces on the nodes with constant direction [N], shape [node_count, 3]."""
        added = self._model_under(1.0).mass_load - self._model.mass_load
        return self._forces + added[:, None] * self._plain.gravity

    def with_young(self, factor: float) -> "LoadedOutdoors":
        """Return the same loads on a branch whose moduli are ``factor`` times as large."""
        other = copy.copy(self)
        other._model = self._model.with_young(self._model.young * factor)
        other._plain = self._plain.with_young(self._plain.young * factor)
        return other

    def with_gusts(self, factor: float) -> "LoadedOutdoors":
        """Return the same loads with a wind of ``factor`` times the pressure."""
        other = copy.copy(self)
        other._forces = self._forces + (factor - 1) * self._wind
        other._wind = factor * self._wind
        other.wind_force = factor * self.wind_force
        return other

    def sways(self, result: StaticResult, tip: int, damping: RayleighDamping) -> Swaying:
        """Return the response of node ``tip`` to a varying wind about a state."""
        middle, vectors, radius = self._cylinders
        at = point_operator(self._plain.mesh, middle)
        air = at.T @ _air_damping(vectors, radius, np.array(self._loads.wind),
                                  self._loads.drag) @ at
        return swaying(self._model_under(1.0), result.displacement, self._wind, tip, damping, air)

    def rest(self, share: float = 1.0) -> StaticResult:
        """Return the equilibrium under the fraction ``share`` of all loads."""
        return solve_static(self._model_under(share), nodal_forces=share * self._forces)

    def bent(self, result: StaticResult, share: float = 1.0) -> Bent:
        """Return the strains of the wood in a state, and its frequencies."""
        model = self._model_under(share)
        strains = model.largest_principal_strains(result.displacement, carried_strain(self._plain))
        modes = lowest_modes(model, _STABILITY_MODES, result.displacement)
        return Bent(result.displacement, np.where(self.is_gone, 0.0, strains), modes.frequencies)

    def greatest_strain(self, result: StaticResult) -> float:
        """Return the largest principal strain of the part that is not cut off."""
        strains = self._plain.largest_principal_strains(result.displacement,
                                                        carried_strain(self._plain))
        return float(strains[~self.is_gone].max())

    def along(self, strains: np.ndarray, count: int = 10) -> list[dict[str, float]]:
        """Return the greatest strain in equal parts of the main path, from the root."""
        path = self.skeleton.main_path()
        length = self.skeleton.arc_length[path]
        nearest = cKDTree(self.skeleton.nodes).query(self._plain.mesh.centroids)[1]
        arc = np.full(self.skeleton.node_count, -1.0)
        arc[path] = length
        at = arc[nearest]
        cuts = np.linspace(0.0, length[-1], count + 1)
        found = []
        for low, high in pairwise(cuts):
            own = (at >= low) & (at <= high) & ~self.is_gone
            if own.any():
                found.append({"from_m": float(low), "to_m": float(high),
                              "strain": float(strains[own].max())})
        return found

    def _model_under(self, share: float) -> BranchModel:
        if not self._masses:
            return self._model
        return self._model.with_point_masses(
            PointMass(one.position, share * one.mass) for one in self._masses)


def wind_forces(vectors: np.ndarray, radius: np.ndarray, wind: np.ndarray, drag: float,
                ) -> np.ndarray:
    """Return the drag [n, 3] [N] on cylinders from start to end ``vectors`` [n, 3] [m], from the
    flow across each (Morison)."""
    length = np.linalg.norm(vectors, axis=1)
    tangent = vectors / np.maximum(length, 1e-300)[:, None]
    across = wind - (tangent @ wind)[:, None] * tangent
    speed = np.linalg.norm(across, axis=1)
    return (0.5 * AIR_DENSITY * drag * 2 * radius * length * speed)[:, None] * across


def _air_damping(vectors: np.ndarray, radius: np.ndarray, wind: np.ndarray, drag: float,
                 ) -> sp.spmatrix:
    """Return the derivative of the drag on cylinders to the wind [N s/m], block diagonal."""
    length = np.linalg.norm(vectors, axis=1)
    tangent = vectors / np.maximum(length, 1e-300)[:, None]
    across = wind - (tangent @ wind)[:, None] * tangent
    speed = np.maximum(np.linalg.norm(across, axis=1), 1e-12)[:, None, None]
    plane = np.eye(3) - tangent[:, :, None] * tangent[:, None, :]
    blocks = (0.5 * AIR_DENSITY * drag * 2 * radius * length)[:, None, None] * (
        speed * plane + across[:, :, None] * across[:, None, :] / speed)
    return sp.block_diag(list(blocks), format="csr")


def _snow(model: BranchModel, middle: np.ndarray, vectors: np.ndarray, radius: np.ndarray,
          load: float) -> list[PointMass]:
    if load <= 0 or not model.gravity.any():
        return []
    down = model.gravity / np.linalg.norm(model.gravity)
    flat = np.linalg.norm(vectors - (vectors @ down)[:, None] * down, axis=1)
    return [PointMass((float(x), float(y), float(z)), float(mass))
            for (x, y, z), mass in zip(middle, load * 2 * radius * flat, strict=True) if mass > 0]


def _beyond(skeleton: Skeleton, cuts: Sequence[tuple[float, float, float]]) -> np.ndarray:
    """Which nodes of the axes are cut off, shape [n] of bool."""
    gone = np.zeros(skeleton.node_count, bool)
    for cut in cuts:
        node = int(np.linalg.norm(skeleton.nodes - np.array(cut), axis=1).argmin())
        distance = float(np.linalg.norm(skeleton.nodes[node] - np.array(cut)))
        is_away = distance > max(3 * skeleton.radius[node], 0.02)
        if node == 0 or is_away:
            raise InputError(f"The cut at {cut} m is invalid.",
                             f"It is {1e3 * distance:.0f} mm away from the branch." if is_away
                             else "It lies at the base.",
                             "Give a position on the branch, in its frame [m].").at(cut)
        gone[node] = True
    for node in range(1, skeleton.node_count):
        gone[node] |= gone[skeleton.parent[node]]
    return gone


