"""Young's modulus from the ringing of generated branches, against the true one."""

from dataclasses import replace
from functools import partial

import numpy as np

from benchmarks.table import Asked, Row, Setting, share_met
from benchmarks.trial_log import Numbers, numbers_of, source_digest
from limber.core.progress import SILENT
from limber.estimation.vibration.ringing import identify
from limber.geometry.generated import generate_branch
from limber.geometry.reconstruction import mesh_skeleton
from limber.geometry.settings import ReconstructSettings
from limber.geometry.skeleton.skeleton import Skeleton
from limber.mechanics.dynamics.modes import Modes, lowest_modes
from limber.mechanics.model import BranchModel
from limber.stages.moduli.vibration import VibrationSettings, young_of

_DENSITY, _POISSON, _YOUNG = 800.0, 0.35, 1e9
_EACH = 10
"""Trials per geometry."""
_FINER = 0.7
"""Spacing of the truth's mesh over that of the estimate's."""
_NOISE = 0.05
"""Noise as a fraction of the record's largest reading."""
_PERIODS, _READINGS = 25, 40
"""Periods in the record; readings per period."""


RINGING_ROW = Asked("modulus of generated branches from a noisy swing: covered by the 95 % "
                    "interval", "88 to 99 %")


def rung(setting: Setting) -> list[Row]:
    """Branches with drawn modulus, density and radii, plucked, recorded with noise, estimated."""
    source = source_digest(("estimation", "mechanics", "geometry", "stages"), __file__)
    groups = numbers_of("ringing", setting.seeds(20, 1), partial(_ringing, source=source), source,
                        setting.kept / "worker-ringing.jsonl", setting.budget, None,
                        setting.progress)
    covered, errors, frequencies = (
        np.concatenate([group.values[name] for group in groups]).astype(float)
        for name in ("covered", "errors", "frequencies"))
    share, count = float(covered.mean()), len(covered)
    return [Row(*RINGING_ROW, f"{100 * share:.0f} %; error "
                f"{100 * np.median(errors):.1f} % (median), of the first frequency "
                f"{100 * np.median(frequencies):.2f} % (worst {100 * max(frequencies):.1f} %)",
                share_met(share, count, 0.88, 0.99), count)]


def _ringing(seed: int, source: str) -> Numbers:
    """Several trials on one generated geometry."""
    rng, settings = np.random.default_rng([seed, 77]), VibrationSettings()
    skeleton = generate_branch(int(rng.integers(1, 10**6))).skeleton
    assumed = _model(skeleton, 1.0, _YOUNG, _DENSITY)
    found: dict[str, list[float]] = {"covered": [], "errors": [], "frequencies": []}
    for _ in range(_EACH):
        true = float(_YOUNG * np.exp(rng.normal(0, 0.5)))
        real = replace(skeleton, radius=skeleton.radius * np.exp(
            settings.radius_sigma * rng.normal()))
        branch = _model(real, _FINER, true,
                        _DENSITY * float(np.exp(settings.density_sigma * rng.normal())))
        modes = lowest_modes(branch, 3)
        node = int(np.linalg.norm(branch.mesh.nodes
                                  - skeleton.nodes[skeleton.main_path()[-1]], axis=1).argmin())
        seen = identify(*_record(modes, node, rng))
        told = young_of(assumed, seen, settings)
        away = float(np.log(told["young_factor"] * _YOUNG / true))
        found["covered"].append(float(abs(away) < 1.96 * told["deviation"]))
        found["errors"].append(abs(away))
        found["frequencies"].append(float(abs(
            seen.frequencies[0] / modes.frequencies[0] - 1)))
    return Numbers("ringing", seed, source, found)


def _model(skeleton: Skeleton, spacing: float, young: float, density: float) -> BranchModel:
    plain = ReconstructSettings()
    mesh = mesh_skeleton(skeleton, plain.model_copy(
        update={"mesh_spacing": spacing * plain.mesh_spacing}), SILENT).mesh
    return BranchModel(mesh, young=young, poisson=_POISSON, density=density).as_scanned()


def _record(modes: Modes, node: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Times and two channels: a pluck of the tip, observed as displacement or as acceleration."""
    frequencies = modes.frequencies
    times = np.arange(0, _PERIODS / frequencies[0], 1 / (_READINGS * frequencies[0]))
    pluck = rng.normal(size=3)
    order = 2 if rng.random() < 0.5 else 0
    found = np.zeros((len(times), 2))
    for frequency, shape in zip(frequencies, modes.shapes, strict=True):
        omega, ratio = 2 * np.pi * frequency, rng.uniform(0.01, 0.04)
        size = shape[node] * (shape[node] @ pluck) * omega**order / omega**2
        found += (np.exp(-ratio * omega * times) * np.cos(omega * np.sqrt(1 - ratio**2) * times)
                  )[:, None] * size[:2]
    return times, found + _NOISE * np.abs(found).max() * rng.standard_normal(found.shape)
