"""The paper's way of driving, by the measured force, beside driving by pose, under noise.

A force bends a branch little beyond its last control point, and its own noise moves all points at
once: the outer modulus is known to within a factor, and the interval has to say so.
"""

from dataclasses import replace

import numpy as np

from benchmarks.paper_branches import BRANCHES, Bench, exact_pull, measured
from benchmarks.table import Row
from limber.estimation.settings import EstimateSettings
from limber.jobs import run_tasks

SETTINGS = EstimateSettings(hold_out=False)
DRIVES = ("pose", "force")


def force_rows(seeds: int) -> list[Row]:
    """Both drives on the three branches, one pull of 60 frames each, ``seeds`` noises."""
    tasks = [(number, seed) for number in range(len(BRANCHES)) for seed in range(seeds)]
    found = np.array(run_tasks(fitted, [(task,) for task in tasks])).reshape(
        len(BRANCHES), seeds, len(DRIVES), 2, 4)
    table = []
    for number, drive in enumerate(DRIVES):
        errors, covered = found[:, :, number, 0], found[:, :, number, 1]
        each = "; ".join(
            f"{branch.name} {100 * np.median(off[:, :3].max(axis=1)):.1f} %, E4 "
            f"{100 * np.median(off[:, 3]):.0f} %"
            for branch, off in zip(BRANCHES, np.abs(errors), strict=True))
        share = float(covered.mean())
        table.append(Row(
            f"1 mm, 2 % force noise, one pull driven by {drive}: median over {seeds} seeds of the "
            "worst error of E1..E3, and of E4; intervals that hold the truth", "88 to 99 %",
            f"{each}; {100 * share:.0f} % of {covered.size}",
            None if seeds < 10 else bool(0.88 <= share <= 0.99)))
    return table


def fitted(task: tuple[int, int]) -> list[list[list[float]]]:
    """Relative errors, and whether the intervals hold the truth, for each drive."""
    number, seed = task
    branch = BRANCHES[number]
    bench, truth = Bench(branch), np.array(branch.young)
    noisy = measured(exact_pull(branch, seed % 3, frames=60), 2000 + seed)
    results = []
    for drive in DRIVES:
        entry = noisy.entry.model_copy(update={"drive": drive})
        found = bench.fit([replace(noisy, entry=entry)], SETTINGS)
        low, high = found.uncertainty.young_interval.T
        results.append([bench.errors(found).tolist(),
                        ((low <= truth) & (truth <= high)).astype(float).tolist()])
    return results
