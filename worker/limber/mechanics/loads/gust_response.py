"""Gusts: how far turbulence moves a branch beyond its mean displacement.

Turbulence is the same along the whole branch, which is shorter than a gust; across the wind it is
left out. The branch responds with its lowest modes about its equilibrium in the mean wind; the rest
of its response is quasi-static.

Sources: A. G. Davenport, *Note on the distribution of the largest value of a random function with
application to gust loading*, 1964; EN 1991-1-4:2005, annex B, for spectrum (B.1), peak factor
(B.4), rate of crossings (B.5).
"""

import math
from dataclasses import dataclass

import numpy as np
import scipy

from limber.mechanics.dynamics.modes import lowest_modes
from limber.mechanics.materials.materials import RayleighDamping
from limber.mechanics.model import BranchModel

_MODES = 6
_LEAST_PEAK = 3.0
_LEAST_CROSSING = 0.08
_POINTS = 6000


@dataclass(frozen=True)
class Swaying:
    """The response of one displacement of a branch to a force that varies as a whole.

    Attributes:
        frequencies: Frequencies of the modes [Hz], shape [k].
        damping: Damping ratios, including aerodynamic damping, shape [k].
        shares: Fraction of each mode in the static response; the remainder to 1 is quasi-static,
        shape [k].
    """

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
    """The effect of gusts on a mean load.

    Attributes:
        factor: The load that statically bends the branch as far as the peak of its sway, over the
            mean load.
        deviation: Standard deviation of the displacement over its mean.
        peak_factor: Standard deviations from mean to peak.
        crossing: Rate at which the displacement crosses its mean upwards [Hz].
        dynamic: Standard deviation over that of a quasi-static branch.
    """

    factor: float
    deviation: float
    peak_factor: float
    crossing: float
    dynamic: float


def swaying(model: BranchModel, displacement: np.ndarray, force: np.ndarray, tip: int,
            damping: RayleighDamping, air: np.ndarray | None = None) -> Swaying:
    """Return the response of a node's displacement to a force about an equilibrium.

    Args:
        model: The branch.
        displacement: Displacement of the equilibrium [m], shape [node_count, 3].
        force: The varying force [N], shape [node_count, 3].
        tip: The node; its displacement is taken in the direction in which the force moves it.
        damping: Damping of the wood.
        air: Aerodynamic force per velocity [N s/m], shape [3 node_count, 3 node_count] or as a
            product with it; None: none.
    """
    tangent = model.equations(()).tangent(model, displacement)
    static = tangent.solve(force)[tip]
    direction = static / np.linalg.norm(static)
    modes = lowest_modes(model, _MODES, displacement)
    omega = 2 * np.pi * modes.frequencies
    loads = np.einsum("kni,ni->k", modes.shapes, force)
    shares = modes.shapes[:, tip] @ direction * loads / omega**2 / float(static @ direction)
    share = (damping.mass / omega + damping.stiffness * omega) / 2
    if air is not None:
        flat = modes.shapes.reshape(len(omega), -1)
        share = share + np.einsum("ki,ki->k", flat, (air @ flat.T).T) / (2 * omega)
    return Swaying(modes.frequencies, share, shares)


def wind_spectrum(frequency: np.ndarray, speed: float, length: float) -> np.ndarray:
    """Return the spectrum of the speed along the wind over its variance [1/Hz], EN 1991-1-4 B.1.

    Args:
        frequency: [Hz].
        speed: Mean [m/s].
        length: Turbulent length scale [m].
    """
    slowness = length / speed
    return 6.8 * slowness / (1 + 10.2 * slowness * np.asarray(frequency)) ** (5 / 3)


def turbulent(sway: Swaying, speed: float, intensity: float, length: float, seconds: float,
              ) -> GustResponse:
    """Return the effect of turbulence with a spectrum on a branch.

    Args:
        sway: Response of the displacement in question.
        speed: Mean speed of the wind [m/s].
        intensity: Standard deviation of the speed over its mean.
        length: Turbulent length scale [m].
        seconds: Duration for which the peak is expected.
    """
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
    """Return the effect of a recorded wind on a branch; the load goes with the square of its speed.

    Args:
        sway: Response of the displacement in question.
        times: [s], ascending, shape [n].
        speeds: Speeds along the mean wind [m/s], shape [n].
    """
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
