"""Requirements on geometry: accuracy on generated branches, real scans beside others' results.

Cases are those of the bench `scans`; with ``--out``, every one is also drawn.
"""

from itertools import product

import numpy as np

from benchmarks import real_scans
from benchmarks.real_scans import AS_IT_IS, DATA, SCANS
from benchmarks.scan_scores import Outcomes, outcomes
from benchmarks.table import Asked, Part, Row, Setting
from benchmarks.trials import Trial, sound
from limber.core.errors import InputError
from limber.geometry.io.skeletons import read_cylinders

VIEWS = ("round", "one-sided")
_RADIUS_LIMITS = {"round": 0.08, "one-sided": 0.12}
_GENERATED = {(view, what): Asked(f"generated, {view}: {measure}", asked.format(
    100 * _RADIUS_LIMITS[view])) for view, (what, measure, asked) in product(VIEWS, (
        ("centre", "centreline error", "25 % of radius or 0.7 mm"),
        ("radius", "radius error, median over nodes", "{:.0f} %"),
        ("forks", "forks found / false", "95 % / under 5 %")))}
_WATERTIGHT = Asked("generated: surface watertight, no self-intersection", "all")
_VOLUME = Asked("generated: mesh volume against the true branch", "within 5 %")
_PAPER_RADII = Asked("the paper's k-nearest median radii, against ours (for comparison)", "-")
_SURFACES = Asked("real scans: surface watertight, no self-intersection", "all")
_EXPLAINED = Asked("real scans: points no farther outside a branch than twice their spacing",
                   "report")
_WHOLE = Asked("whole `reconstruct` of coffeetree_branch", "30 s")
_QSM = (Asked("aRchi_tree_1: total length, ours / TreeQSM", "report"),
        Asked("aRchi_tree_1: radius over 5 mm, ours against TreeQSM", "report"),
        Asked("aRchi_tree_1: length by order [m]", "report"))
_AUTHORS = {name: Asked(f"{stem}: axes against the authors'", "report")
            for name, stem in (("tomato", "tomato_03-05"), ("maize", "maize_03-13"))}


def _generated(setting: Setting) -> list[Row]:
    """Accuracy on generated branches, each scanned all round and from one side."""
    count = setting.at_most(60, 4)
    done = outcomes(setting, dict.fromkeys(VIEWS, count))
    return [*(row for view in VIEWS for row in _view_rows(view, done[view])),
            *_body_rows(done["round"], list(done.values()))]


def _view_rows(view: str, one: Outcomes) -> list[Row]:
    if not one.scores:
        return []
    centre, share, error, bias = (one.column(name) for name in (
        "centre_m", "centre_radii", "radius_error", "radius_bias"))
    met = (share < 0.25) | (centre < 0.0007)
    text, found, false = one.forks()
    return [
        Row(*_GENERATED[view, "centre"],
            f"mean {100 * share.mean():.0f} % ({1000 * centre.mean():.2f} mm), worst "
            f"{100 * share.max():.0f} % ({1000 * centre.max():.2f} mm); {met.sum()}/{one.count} "
            f"met{one.told()}", bool(met.all() and not one.failed), one.count),
        Row(*_GENERATED[view, "radius"],
            f"mean {100 * error.mean():.1f} %, worst {100 * error.max():.1f} %, bias "
            f"{100 * bias.mean():+.1f} %", bool((error < _RADIUS_LIMITS[view]).all()), one.count),
        Row(*_GENERATED[view, "forks"], text, found >= 0.95 and false < 0.05
            if one.column("forks").any() else None, one.count)]


def _body_rows(round_cases: Outcomes, views: list[Outcomes]) -> list[Row]:
    if not round_cases.scores:
        return []
    valid, count = sum(int(one.column("watertight").sum()) for one in views), sum(
        one.count for one in views)
    volumes = round_cases.column("volume")
    return [Row(*_WATERTIGHT, f"{valid}/{count}", valid == count, count),
            Row(*_VOLUME, f"mean {100 * volumes.mean():+.1f} %, worst "
                f"{100 * np.abs(volumes).max():.1f} %", bool((np.abs(volumes) < 0.05).all()),
                len(volumes)),
            Row(*_PAPER_RADII, f"differ by {100 * np.median(round_cases.column('paper')):.0f} % "
                "(median)", None, len(volumes))]


def _scans(setting: Setting) -> list[Row]:
    """Reconstruct real scans, and compare them with the results of others."""
    names = ["coffee", "apple-25"] if setting.quick else list(SCANS)
    runs = real_scans.runs(setting, [(name, AS_IT_IS) for name in real_scans.present(names)])
    done, count = {run.task[0]: run for run in sound(runs)}, len(runs)
    valid = sum(run["watertight"] for run in done.values())
    notes = [f"{run.task[0]} {run.seconds:.0f} s " + (
        "FAILED" if run.failure else f"{run['tets']} tets") for run in runs]
    table = [Row(*_SURFACES, f"{valid}/{count} ({'; '.join(notes)})", valid == count, count),
             Row(*_EXPLAINED, "; ".join(f"{name} {run['explained']:.0%}"
                                        for name, run in done.items()), None, count)]
    if "coffee" in done:
        seconds = done["coffee"].seconds
        table.append(Row(*_WHOLE, f"{seconds:.1f} s", seconds <= 30))
    if "tree" in done:
        table += _qsm_rows(done["tree"])
    return table + [Row(*asked, f"{1e3 * done[name]['there_m']:.2f} mm to theirs, "
                        f"{1e3 * done[name]['back_m']:.2f} mm back (mean)", None)
                    for name, asked in _AUTHORS.items() if name in done]


def _qsm_rows(ours: Trial) -> list[Row]:
    """Beside TreeQSM's cylinders of the same tree: a reference, not truth."""
    text = f"ours {_by_order(ours['by_order_m'])}"
    try:
        theirs = read_cylinders(DATA / "aRchi_tree_1" / "Tree_1_cylinders_TreeQSM.csv")
        text += "; TreeQSM " + _by_order([theirs.steps[1:][theirs.order[1:] == k].sum()
                                          for k in range(4)])
    except InputError:
        # Loose cylinders are no tree.
        pass
    median, size, share = ours["radius_off"]
    told = (f"{ours['length_m']:.0f} m / {real_scans.reference_length('tree'):.0f} m",
            f"median {100 * median:+.0f} %, median |difference| {100 * size:.0f} % on {share:.0%} "
            "of its cylinders", text)
    return [Row(*asked, each, None) for asked, each in zip(_QSM, told, strict=True)]


def _by_order(lengths: list[float]) -> str:
    return ", ".join(f"{order}: {length:.0f}" for order, length in enumerate(lengths))


PARTS = {
    "generated": Part(_generated, 20, (*_GENERATED.values(), _WATERTIGHT, _VOLUME, _PAPER_RADII),
                      grows=True),
    "scans": Part(_scans, 40, (_SURFACES, _EXPLAINED, _WHOLE, *_QSM, *_AUTHORS.values()),
                  grows=True)}
"""The table, in order of importance."""
