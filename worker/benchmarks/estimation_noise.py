"""The paper's three branches under noise, over many seeds; a stopped run goes on.

Each trial is a fit of one pull or of three with fresh noise on points and force; what is kept of
it tells error, interval and whether the truth lies inside.
"""

import time
from collections.abc import Iterator
from concurrent.futures import as_completed
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks import paper_branches
from benchmarks.kept_trials import keep, read_trials, source_digest
from benchmarks.paper_branches import BRANCHES, Bench, exact_pull, measured
from benchmarks.table import Row
from limber.estimation.settings import EstimateSettings
from limber.jobs import Pool
from limber.progress import Progress

SETTINGS = EstimateSettings(hold_out=False)
PULL_COUNTS = (1, 3)


@dataclass(frozen=True)
class Trial:
    """One fit under noise.

    Attributes:
        branch: Number of the branch in :data:`benchmarks.paper_branches.BRANCHES`.
        seed: Of the noise.
        pulls: How many pulls were fitted together.
        errors: Relative errors of the moduli, shape [4].
        low, high: 95 % interval over the true modulus, shape [4].
        variance_factor: Mean squared residual over the stated.
        group_count: Moduli fitted; fewer than 4 where some were tied.
        seconds: Of the fit.
        source: Digest of the estimator's source; another one's trials are not taken over.
    """

    branch: int
    seed: int
    pulls: int
    errors: tuple[float, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    variance_factor: float
    group_count: int
    seconds: float
    source: str

    @property
    def worst(self) -> float:
        return float(np.abs(self.errors).max())

    @property
    def covered(self) -> np.ndarray:
        """Whether each interval holds the truth, shape [4] of bool."""
        return (np.array(self.low) <= 1) & (np.array(self.high) >= 1)


def noise_rows(seeds: int, progress: Progress, kept: Path | None, workers: int = 2) -> list[Row]:
    """Measure ``seeds`` noises of each branch; with ``kept``, a file of trials, go on with it."""
    trials = run_trials(seeds, progress, kept, workers)
    table = []
    for label, asked, count in (("one pull", 0.06, 1), ("three pulls", 0.03, 3)):
        medians = [float(np.median([trial.worst for trial in trials
                                    if (trial.branch, trial.pulls) == (number, count)]))
                   for number in range(len(BRANCHES))]
        each = ", ".join(f"{branch.name} {100 * median:.1f} %"
                         for branch, median in zip(BRANCHES, medians, strict=True))
        table.append(Row(
            f"1 mm, 2 % force noise, {label}: median over {seeds} seeds of the worst E error",
            f"{100 * asked:.0f} %", each, max(medians) <= asked))
    covered = np.concatenate([trial.covered for trial in trials])
    share = float(np.mean(covered))
    each = ", ".join(
        f"{branch.name} {100 * np.mean([t.covered for t in trials if t.branch == number]):.0f} %"
        for number, branch in enumerate(BRANCHES))
    table.append(Row("95 % intervals that cover the truth", "88 to 99 %",
                     f"{100 * share:.1f} % of {len(covered)} ({each})",
                     0.88 <= share <= 0.99))
    return table


def run_trials(seeds: int, progress: Progress, kept: Path | None, workers: int = 2) -> list[Trial]:
    """All trials, those that ``kept`` has from the same estimator included."""
    source = _source_digest()
    known = {(t.branch, t.seed, t.pulls): t for t in read_trials(Trial, kept)
             if t.source == source}
    wanted = [(branch, seed) for seed in range(seeds) for branch in range(len(BRANCHES))]
    missing = [task for task in wanted
               if any((*task, count) not in known for count in PULL_COUNTS)]
    done = len(wanted) - len(missing)
    for trial in _computed(missing, workers):
        known[trial.branch, trial.seed, trial.pulls] = trial
        keep(trial, kept)
        if trial.pulls == PULL_COUNTS[-1]:
            done += 1
            progress(done / len(wanted), "noise over seeds")
    return [known[(*task, count)] for task in wanted for count in PULL_COUNTS]


def trials_of(task: tuple[int, int]) -> list[Trial]:
    """Fit one branch under one noise: with one pull and with three."""
    number, seed = task
    branch = BRANCHES[number]
    bench = Bench(branch)
    noisy = [measured(pull, 1000 + seed) for pull in _exact_pulls(number)]
    truth, trials = np.array(branch.young), []
    for count in PULL_COUNTS:
        started = time.perf_counter()
        found = bench.fit(noisy[:count], SETTINGS)
        low, high = (found.uncertainty.young_interval / truth[:, None]).T
        trials.append(Trial(
            number, seed, count, tuple(bench.errors(found).tolist()), tuple(low.tolist()),
            tuple(high.tolist()), found.uncertainty.variance_factor,
            found.objective.space.group_count, round(time.perf_counter() - started, 2),
            _source_digest()))
    return trials


def _computed(tasks: list[tuple[int, int]], workers: int) -> Iterator[Trial]:
    if workers < 2:
        for task in tasks:
            yield from trials_of(task)
        return
    with Pool(workers) as pool:
        for future in as_completed([pool.submit(trials_of, task) for task in tasks]):
            yield from future.result()


_PULLS: dict[int, list] = {}


def _exact_pulls(number: int) -> list:
    """Pulls without noise, simulated once a process."""
    if number not in _PULLS:
        _PULLS[number] = [exact_pull(BRANCHES[number], pull) for pull in range(3)]
    return _PULLS[number]


def _source_digest() -> str:
    return source_digest(("estimation",), paper_branches.__file__)
