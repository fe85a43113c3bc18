"""States that are what they are said to be: swings keep their energy."""

import numpy as np

from benchmarks.mechanics import DENSITY, short_beam
from benchmarks.table import Row
from limber.mechanics import (
    BranchModel,
    EnergyMomentumSettings,
    Grasp,
    RayleighDamping,
    simulate_dynamics,
    solve_static,
)
from limber.progress import Progress

_AMPLITUDES = (0.01, 0.25, 0.6)
_STEPS = 1000
_YOUNG = 1e7


def rows(quick: bool, progress: Progress, seed: int) -> list[Row]:
    """Measure everything; ``seed`` is the base of all that is drawn."""
    return [swing_row(quick, progress, np.random.default_rng([seed, 11]))]


def swing_row(quick: bool, progress: Progress, rng: np.random.Generator) -> Row:
    """An undamped beam let go from aside, in the default step of 1/60 s."""
    mesh, tip = short_beam()
    model = BranchModel(mesh, young=_YOUNG, poisson=0.3, density=DENSITY, gravity=None,
                        damping=RayleighDamping(0.0, 0.0))
    told, worst, count = [], 0.0, 200 if quick else _STEPS
    for number, amplitude in enumerate(_AMPLITUDES):
        progress(number / len(_AMPLITUDES), f"swinging at {100 * amplitude:.0f} %")
        angle = rng.uniform(0, 2 * np.pi)
        bent = _pulled_aside(model, tip, np.array([np.cos(angle), np.sin(angle), 0.0]), amplitude)
        settings = EnergyMomentumSettings()
        result = simulate_dynamics(model, times=settings.max_step * np.arange(count + 1),
                                   start=bent, settings=settings)
        energy = result.strain_energy + result.kinetic_energy
        drift = 100 * np.abs(energy / energy[0] - 1).max() if result.converged else np.inf
        worst = max(worst, drift)
        told.append(f"{drift:.4f} %")
    return Row(f"free swing at 1, 25, 60 % amplitude, {count} steps of 1/60 s: energy drift",
               "1 %", ", ".join(told), bool(worst <= 1))


def _pulled_aside(model: BranchModel, tip: Grasp, direction: np.ndarray,
                  amplitude: float) -> np.ndarray:
    """Return the state [m] under a force that brings the tip aside by a part of the length."""
    from scipy.optimize import brentq

    length = np.ptp(model.mesh.nodes[:, 2])

    def pulled(force: float) -> np.ndarray:
        return solve_static(model, grasp=tip, grasp_force=force * direction).require().displacement

    def missing(force: float) -> float:
        return float(tip.weights @ pulled(force)[tip.nodes] @ direction) / length - amplitude

    most = 0.01
    while missing(most) < 0:
        most *= 2
    return pulled(brentq(missing, 0.0, most, rtol=1e-3))
