"""The paper's three branches under noise, over many seeds; a stopped run continues.

Each trial is a fit of one pull or of three with fresh noise on points and force. It keeps error,
interval and whether the truth is inside.
"""

import time
from dataclasses import dataclass

import numpy as np

from benchmarks import paper_branches
from benchmarks.paper_branches import BRANCHES, Bench, exact_pull, measured
from benchmarks.table import Asked, Row, Setting, share_met
from benchmarks.trial_log import go_on, read_trials, source_digest
from limber.estimation.settings import EstimateSettings

SETTINGS = EstimateSettings(hold_out=False)
PULL_COUNTS = (1, 3)


@dataclass(frozen=True)
class Trial:
    """One fit under noise.

    Attributes:
        branch: Number of the branch in :data:`benchmarks.paper_branches.BRANCHES`.
        seed: Seed of the noise.
        pulls: Number of pulls fitted together.
        errors: Relative errors of the moduli, shape [4].
        low, high: 95 % interval over the true modulus, shape [4].
        variance_factor: Mean squared residual over the stated variance.
        group_count: Moduli fitted; fewer than 4 where some were tied.
        seconds: Time of the fit.
        source: Digest of the estimator's source; trials of another one are not reused.
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
        """Whether each interval contains the truth, shape [4] of bool."""
        return (np.array(self.low) <= 1) & (np.array(self.high) >= 1)


NOISE_ROWS = (
    Asked("1 mm, 2 % force noise, one pull: median over seeds of the worst E error", "6 %"),
    Asked("1 mm, 2 % force noise, three pulls: median over seeds of the worst E error", "3 %"),
    Asked("95 % intervals that cover the truth", "88 to 99 %"))
_LIMITS = (0.06, 0.03)


def noise_rows(setting: Setting) -> list[Row]:
    """Measure as many noise seeds of each branch as there is time for."""
    seeds = setting.seeds(20, 3)
    tasks = [(branch, seed, pulls) for seed in seeds for branch in range(len(BRANCHES))
             for pulls in PULL_COUNTS]
    kept = setting.kept / "estimation-noise.jsonl"
    trials = go_on(read_trials(Trial, kept), tasks, lambda each: (each.branch, each.seed,
                                                                  each.pulls),
                   trial_of, _source_digest(), kept, setting.budget, None, setting.progress)
    table = [_error_row(asked, limit, [each for each in trials if each.pulls == pulls])
             for asked, limit, pulls in zip(NOISE_ROWS, _LIMITS, PULL_COUNTS, strict=False)]
    covered = np.concatenate([trial.covered for trial in trials])
    share = float(np.mean(covered))
    each = ", ".join(f"{branch.name} {100 * np.mean(held):.0f} %"
                     for number, branch in enumerate(BRANCHES)
                     if (held := [t.covered for t in trials if t.branch == number]))
    return [*table, Row(*NOISE_ROWS[2], f"{100 * share:.1f} % of {len(covered)} ({each})",
                        share_met(share, len(covered), 0.88, 0.99), len(trials))]


def _error_row(asked: Asked, limit: float, trials: list[Trial]) -> Row:
    """The worst median of the three branches; not judged while one of them is missing."""
    medians = {branch.name: float(np.median(worst)) for number, branch in enumerate(BRANCHES)
               if (worst := [trial.worst for trial in trials if trial.branch == number])}
    if not medians:
        return asked.not_shown()
    each = ", ".join(f"{name} {100 * median:.1f} %" for name, median in medians.items())
    return Row(*asked, each, max(medians.values()) <= limit
               if len(medians) == len(BRANCHES) else None, len(trials))


def trial_of(task: tuple[int, int, int]) -> Trial:
    """Fit one branch under one noise, with one pull or with several."""
    number, seed, count = task
    branch = BRANCHES[number]
    bench = Bench(branch)
    noisy = [measured(pull, seed) for pull in _exact_pulls(number)[:count]]
    truth, started = np.array(branch.young), time.perf_counter()
    found = bench.fit(noisy, SETTINGS)
    low, high = (found.uncertainty.young_interval / truth[:, None]).T
    return Trial(
        number, seed, count, tuple(bench.errors(found).tolist()), tuple(low.tolist()),
        tuple(high.tolist()), found.uncertainty.variance_factor,
        found.objective.space.group_count, round(time.perf_counter() - started, 2),
        _source_digest())


_PULLS: dict[int, list] = {}


def _exact_pulls(number: int) -> list:
    """Pulls without noise, simulated once per process."""
    if number not in _PULLS:
        _PULLS[number] = [exact_pull(BRANCHES[number], pull) for pull in range(3)]
    return _PULLS[number]


def _source_digest() -> str:
    return source_digest(("estimation",), __file__, paper_branches.__file__)
