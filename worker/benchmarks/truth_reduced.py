"""Whether a reduced model flags its bad states after E changed; a stopped run continues.

Training and test grasps are taken in pieces that are kept, each of some ten seconds.
"""

import time
from functools import partial

import numpy as np

from benchmarks import mechanics_reduced
from benchmarks.mechanics_reduced import CHANGED, LENGTH, GraspBench, bench_branch
from benchmarks.table import Asked, Row, Setting
from benchmarks.trial_log import Numbers, numbers_of, source_digest
from limber.reduced.reduced_model import ReducedModel
from limber.reduced.refresh import checked, estimate_error
from limber.reduced.training import Snapshots, TrainingSettings, sample_poses

DOUBT_ROWS = (
    Asked("reduced model after E changed by up to 3: worst error among the unflagged",
          "0.5 % of the length, 1 % energy"),
    Asked("bad states flagged / good ones flagged", "95 % / under 10 %"))
_KNOWN, _VARIED, _PIECE = 120, 160, 20  # training grasps with the known moduli, with others; each
_SPREAD, _CHANGE = 4.0, 3.0  # largest factor of the moduli in training, and in the test
_LARGEST = 1e9  # percent
_TESTED, _TESTS = 300, 10  # test grasps, and those of one trial


def doubt_rows(setting: Setting) -> list[Row]:
    """Grasps of a reduced model after E changed by up to 3 at each control point, checked."""
    source = source_digest(("mechanics", "reduced"), __file__, mechanics_reduced.__file__)
    bench = GraspBench(bench_branch(), "point", setting.seed)
    known = _trained(bench, setting, source)
    if known is None:
        return [Row(*asked, "the training goes on with the same --seed and --out", None, 0)
                for asked in DOUBT_ROWS]
    setting.progress(0.5, "building the reduced model")
    model = bench.reduce(known, CHANGED)
    first = 1000 * setting.seed
    trials = numbers_of(
        "reduced", range(first, first + setting.at_most(_TESTED, 30) // _TESTS),
        partial(_tested, bench=bench, model=model, known=known, source=source), source,
        setting.kept / "truth-reduced.jsonl", setting.budget, progress=setting.progress)
    return _doubted(*(np.concatenate([each.values[name] for each in trials])
                      for name in ("off", "energy", "flagged", "milliseconds")))


def _trained(bench: GraspBench, setting: Setting, source: str) -> Snapshots | None:
    """All training grasps; None: there is no time for all of them."""
    counts = [setting.at_most(_KNOWN, 60), setting.at_most(_VARIED, 100)]
    spreads = [spread for count, spread in zip(counts, (1.0, _SPREAD), strict=True)
               for _ in range(count // _PIECE)]
    found: Snapshots | None = None
    done = 0
    for number in setting.budget.items(range(len(spreads))):
        setting.progress(0.5 * number / len(spreads), "training")
        path = setting.kept / f"reduced-{source}-{setting.seed}-{number}.npz"
        if path.is_file():
            with np.load(path) as held:
                piece = Snapshots.from_arrays(dict(held))
        else:
            piece = bench.trainer.take(*_grasps(
                bench, _PIECE, spreads[number], setting.generator(12, number)), found)
            part = path.with_suffix(".part.npz")
            np.savez(part, **piece.arrays())
            part.replace(path)
        found, done = piece if found is None else found.joined(piece), number + 1
    return found if done == len(spreads) else None


def _grasps(bench: GraspBench, count: int, spread: float, rng: np.random.Generator,
            ) -> tuple[np.ndarray, np.ndarray]:
    """Poses [m, rad], shape [count, 6], and moduli [Pa], shape [count, K], of drawn grasps."""
    branch = bench.branch
    poses = sample_poses(branch.model, bench.grasp, count, rng, TrainingSettings())
    return poses, branch.young * spread**rng.uniform(-1, 1, (count, len(branch.young)))


def _tested(seed: int, bench: GraspBench, model: ReducedModel, known: Snapshots, source: str,
            ) -> Numbers:
    """Some grasps by the full model and by the reduced one, which is checked."""
    truth = bench.trainer.take(*_grasps(bench, _TESTS, _CHANGE, np.random.default_rng([seed, 13])),
                               known)
    branch = bench.branch
    found: dict[str, list] = {"off": [], "energy": [], "flagged": [], "milliseconds": []}
    for pose, young, exact, exact_energy in zip(
            truth.poses, truth.young, truth.displacement, truth.energy, strict=True):
        mixed = model.with_young(young)
        began = time.process_time()
        state = mixed.solve_static(pose)
        state = checked(state, estimate_error(branch.model, branch.weights, mixed, state))
        found["milliseconds"].append(1e3 * (time.process_time() - began))
        away = np.linalg.norm(mixed.displacement(state) - exact, axis=1).max()
        found["off"].append(_finite(100 * away / LENGTH))
        found["energy"].append(_finite(100 * abs(state.strain_energy / exact_energy - 1)))
        found["flagged"].append(not state.trusted)
    return Numbers("reduced", seed, source, found)


def _finite(value: float) -> float:
    """A state without bound is bad too; JSON has no infinity."""
    return float(np.nan_to_num(value, nan=_LARGEST, posinf=_LARGEST))


def _doubted(off: np.ndarray, energy: np.ndarray, flagged: np.ndarray, milliseconds: np.ndarray,
             ) -> list[Row]:
    flagged = flagged.astype(bool)
    bad = (off > 0.5) | (energy > 1)
    worst, worst_energy = off[~flagged].max(initial=0), energy[~flagged].max(initial=0)
    caught = 100 * flagged[bad].mean() if bad.any() else np.nan
    false = 100 * flagged[~bad].mean() if (~bad).any() else np.nan
    return [
        Row(*DOUBT_ROWS[0],
            f"{worst:.2f} %, {worst_energy:.2f} % (among all {off.max():.1f}, {energy.max():.1f} "
            f"%; {np.median(milliseconds):.0f} ms a checked grasp)",
            bool(worst <= 0.5 and worst_energy <= 1), len(off)),
        Row(*DOUBT_ROWS[1],
            f"{caught:.0f} % of {bad.sum()} / {false:.1f} % of {(~bad).sum()}",
            bool(caught >= 95 and false < 10) if bad.any() else None, len(off))]
