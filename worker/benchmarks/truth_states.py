"""Swings keep their energy; reduced models and live updates agree with the full fit."""

import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.estimation import SETTINGS, followed
from benchmarks.mechanics_exact import DENSITY, short_beam
from benchmarks.paper_branches import BRANCHES, Bench, exact_pull, measured
from benchmarks.table import Asked, Row, Setting
from limber.mechanics import (
    BranchModel,
    EnergyMomentumSettings,
    Grasp,
    RayleighDamping,
    simulate_dynamics,
    solve_static,
)

_AMPLITUDES = (0.01, 0.25, 0.6)
_STEPS = 1000
_YOUNG = 1e7

SWING_ROW = Asked("free swing at 1, 25, 60 % amplitude, 1,000 steps of 1/60 s: energy drift",
                  "1 %")
QUICK_ROWS = (
    Asked("a second, different pull with --forward reduced", "10 s"),
    Asked("online: last live update against the batch fit; every frame's time, worst",
          "3 %; 33 ms"))


def swing_row(setting: Setting) -> list[Row]:
    """An undamped beam released from a deflection, in the default step of 1/60 s."""
    mesh, tip = short_beam()
    model = BranchModel(mesh, young=_YOUNG, poisson=0.3, density=DENSITY, gravity=None,
                        damping=RayleighDamping(0.0, 0.0))
    rng = setting.generator(11)
    told, worst, count = [], 0.0, setting.at_most(_STEPS, 200)
    for number, amplitude in enumerate(_AMPLITUDES):
        setting.progress(number / len(_AMPLITUDES), f"swinging at {100 * amplitude:.0f} %")
        angle = rng.uniform(0, 2 * np.pi)
        bent = _pulled_aside(model, tip, np.array([np.cos(angle), np.sin(angle), 0.0]), amplitude)
        settings = EnergyMomentumSettings()
        result = simulate_dynamics(model, times=settings.max_step * np.arange(count + 1),
                                   start=bent, settings=settings)
        energy = result.strain_energy + result.kinetic_energy
        drift = 100 * np.abs(energy / energy[0] - 1).max() if result.converged else np.inf
        worst = max(worst, drift)
        told.append(f"{drift:.4f} %")
    return [Row(*SWING_ROW, f"{', '.join(told)} ({count} steps)", bool(worst <= 1),
                len(_AMPLITUDES))]


def _pulled_aside(model: BranchModel, tip: Grasp, direction: np.ndarray,
                  amplitude: float) -> np.ndarray:
    """Return the state [m] under a force that moves the tip aside by a fraction of the length."""
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


def quick_rows(setting: Setting) -> list[Row]:
    """A new pull on an existing basis; a pull followed while it continues."""
    branch, rng = BRANCHES[1], setting.generator(13)
    # About 2,500 quadratic tetrahedra.
    bench = Bench(branch, slice_length=0.95, sides=10)
    first, second = (measured(exact_pull(branch, number), int(rng.integers(1 << 31)))
                     for number in rng.permutation(3)[:2])
    found = bench.fit([second], SETTINGS)
    with tempfile.TemporaryDirectory() as folder:
        seconds = []
        for pull in (first, second):
            began = time.perf_counter()
            short = bench.fit([pull], SETTINGS.model_copy(update={"forward": "reduced"}),
                              cache=Path(folder))
            seconds.append(time.perf_counter() - began)
    away = float(np.abs(short.values.young / found.values.young - 1).max())
    updates, live, settled = followed(bench, first, second, found)
    return [
        Row(*QUICK_ROWS[0],
            f"{seconds[1]:.1f} s, {100 * away:.2f} % from the full model's E (the first, with the "
            f"basis built, {seconds[0]:.0f} s)", bool(seconds[1] <= 10)),
        Row(*QUICK_ROWS[1], f"{100 * live:.1f} % (settled {100 * settled:.1f} %); "
            f"{1e3 * updates.max():.0f} ms (median {1e3 * np.median(updates):.0f}, 99 % under "
            f"{1e3 * np.percentile(updates, 99):.0f}, {len(updates)} frames)",
            bool(live <= 0.03 and updates.max() <= 0.033), len(updates))]
