"""The paper's drive by the measured force, compared with drive by pose, under noise.

A force bends a branch little beyond its last control point, and its own noise moves all points at
once: the outer modulus is known only to within a factor, and the interval must reflect this.
"""

from dataclasses import replace
from functools import partial

import numpy as np

from benchmarks import paper_branches
from benchmarks.paper_branches import BRANCHES, Bench, exact_pull, measured
from benchmarks.table import Asked, Row, Setting, share_met
from benchmarks.trial_log import Numbers, numbers_of, source_digest
from limber.estimation.settings import EstimateSettings

SETTINGS = EstimateSettings(hold_out=False)
DRIVES = ("pose", "force")


FORCE_ROWS = tuple(Asked(
    f"1 mm, 2 % force noise, one pull driven by {drive}: median over seeds of the worst error of "
    "E1..E3, and of E4; intervals that hold the truth", "88 to 99 %") for drive in DRIVES)


def force_rows(setting: Setting) -> list[Row]:
    """Both drives on the three branches, one pull of 60 frames each, as many noise seeds as fit."""
    source = source_digest(("estimation",), __file__, paper_branches.__file__)
    tasks = [len(BRANCHES) * seed + number for seed in setting.seeds(20, 2)
             for number in range(len(BRANCHES))]
    trials = numbers_of("force", tasks, partial(fitted, source=source), source,
                        setting.kept / "estimation-force.jsonl", setting.budget, None,
                        setting.progress)
    table = []
    for asked, drive in zip(FORCE_ROWS, DRIVES, strict=True):
        covered = np.array([trial.values[drive][1] for trial in trials])
        each = []
        for number, branch in enumerate(BRANCHES):
            off = np.abs([trial.values[drive][0] for trial in trials
                          if trial.seed % len(BRANCHES) == number])
            if len(off):
                each.append(f"{branch.name} {100 * np.median(off[:, :3].max(axis=1)):.1f} %, E4 "
                            f"{100 * np.median(off[:, 3]):.0f} %")
        share = float(covered.mean())
        table.append(Row(*asked, f"{'; '.join(each)}; {100 * share:.0f} % of {covered.size}",
                         share_met(share, covered.size, 0.88, 0.99), len(trials)))
    return table


def fitted(task: int, source: str) -> Numbers:
    """Relative errors, and whether the intervals contain the truth, for each drive.

    Args:
        task: Seed of the noise times the number of branches, and the branch's number.
        source: Digest of the sources.
    """
    seed, number = divmod(task, len(BRANCHES))
    branch = BRANCHES[number]
    bench, truth = Bench(branch), np.array(branch.young)
    noisy = measured(exact_pull(branch, seed % 3, frames=60), seed)
    results = {}
    for drive in DRIVES:
        entry = noisy.entry.model_copy(update={"drive": drive})
        found = bench.fit([replace(noisy, entry=entry)], SETTINGS)
        low, high = found.uncertainty.young_interval.T
        results[drive] = [bench.errors(found).tolist(),
                          ((low <= truth) & (truth <= high)).astype(float).tolist()]
    return Numbers("force", task, source, results)
