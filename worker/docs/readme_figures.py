"""The figures of the README: what commands say of an example, and how well each part does.

``scripts/make_readme_figures`` puts both between the README's marks; a test holds them there. A
figure of the table is a part of what a bench's row says, as `accuracy_page` keeps it.
"""

import re
from collections.abc import Callable
from pathlib import Path
from string import Formatter
from typing import NamedTuple

import numpy as np
from accuracy_page import record

README = Path(__file__).parents[2] / "README.md"
EXAMPLE = README.parent / "blend_files" / "bending_branch"
_SAID, END = "scripts/make_readme_figures writes this. -->", "<!-- End. -->"


class Figure(NamedTuple):
    """Where a figure comes from.

    Attributes:
        bench: Its name.
        measure: A pattern for the beginning of its rows' measures.
        part: A pattern with the figure as its groups, in what a row says.
        over_rows: Puts the groups of several rows together; None: there is one row.
    """

    bench: str
    measure: str
    part: str
    over_rows: Callable[[list[tuple[str, ...]]], str] | None = None


def _share(counts: list[tuple[str, ...]]) -> str:
    """Counts found and there, of all rows, as a percentage."""
    found, there = np.array(counts, int).sum(axis=0)
    return f"{100 * found / there:.0f} %"


def _range(values: list[tuple[str, ...]], sign: str = "+") -> str:
    """The least and the largest of all rows; an error has a sign, a share has none."""
    numbers = [float(value) for value, in values]
    return f"{min(numbers):{sign}g} to {max(numbers):{sign}g} %"


def _shares(values: list[tuple[str, ...]]) -> str:
    return _range(values, "")


def _percent(values: list[tuple[str, ...]]) -> str:
    """The figure of the first row."""
    return f"{values[0][0]} %"


_ONE_SIDE, _ROUND = (rf"worlds, \S+ \(left out\), {view}:" for view in ("one-sided", "round"))
_FORKS, _BIAS = r"\((\d+)/(\d+)\) / ", r"of \S+ m; (\S+)% \(worst"
FIGURES = {
    "other forks, one side": Figure("worlds", _ONE_SIDE, _FORKS, _share),
    "other forks, around": Figure("worlds", _ROUND, _FORKS, _share),
    "other bias, one side": Figure("worlds", _ONE_SIDE, _BIAS, _range),
    "other bias, around": Figure("worlds", _ROUND, _BIAS, _range),
    "real length": Figure("worlds", "worlds, real scans", r"^\d of \d; (\S+)%", _percent),
    "real held": Figure("worlds", "worlds, real scans", r"^(\d of \d);"),
    "other twigs, one side": Figure("worlds", _ONE_SIDE, r"; (\d+)% / ", _shares),
    "other twigs, around": Figure("worlds", _ROUND, r"; (\d+)% / ", _shares),
    "other volume, one side": Figure("worlds", _ONE_SIDE, r"%\); (\S+)%; ", _shares),
    "other volume, around": Figure("worlds", _ROUND, r"%\); (\S+)%; ", _shares),
    "in leaf": Figure("worlds", "worlds, leafy", r"^(\d+)%", _percent),
    "right in leaf": Figure("worlds", "worlds, leafy", r"/ (\d+)% \(worst \d+%\);", _percent),
    "one image": Figure("scans", "single-view: forks", r"^(\d+)%", _percent),
    "one image, radius": Figure("scans", "single-view: radius", r"bias (\S+)%", _percent),
    "one image, volume": Figure("scans", "single-view: mesh volume", r"^worst (\S+)%", _percent),
    "sparse length": Figure("sparse", r"sparse, drooping \([^)]*\): axes found",
                            r"; (\d+)% \(ratio", _percent),
    "sparse volume": Figure("sparse", r"sparse, drooping \([^)]*\): stated",
                            r"(\d+ of \d+) state no volume"),
    "sparse": Figure("sparse", r"sparse, drooping \([^)]*\): axes found", r"^(\d+ / \d+ %)"),
    "sparse held": Figure("sparse", r"sparse, drooping \([^)]*\): stated", r"^(\d+)%", _percent),
    "forks": Figure("scans", "one-sided, noise 1 mm: forks", r"^(\S+)% ", _percent),
    "radius": Figure("scans", "one-sided, noise 1 mm: radius", r"median (\S+)%", _percent),
    "elastica": Figure("mechanics", "cantilever against the elastica: own weight", r"^(\S+ %)"),
    "frequency": Figure("mechanics", "undamped free vibration", r"^(\S+ %)"),
    "held": Figure("truth", "scan to moduli", r"^(\S+ %) of"),
    "worst": Figure("truth", "scan to moduli", r"worst error (\S+ %)\)"),
    "stiffness held": Figure("truth", "the same of bending stiffness E I", r"^(\S+ %) of"),
    "stiffness": Figure("truth", "the same of bending stiffness E I", r"median error (\S+ %)"),
    "drop": Figure("estimation", "silicone_beam: E from", r"\(-?(\S+ %)\)$"),
    "exact": Figure("estimation", "three branches, one pull, exact", r"^(.*)$"),
    "other loads": Figure("estimation", "the same with simulated recordings", r"^(\S+ %)"),
    "depth frames": Figure("estimation", "depth frames of a simulated D455", r"(\S+ %) \("),
    "goals": Figure("planning", "goals of the tip", r"^(\d+ of \d+)"),
    "hopeless": Figure("planning", "unreachable: refused", r"^(\d+ of \d+)"),
    "gap": Figure("planning", "there: certified gap of the energy", r"^(\S+) /", _percent),
    "false proofs": Figure("planning", "limits within 5 %", r"^(\d+ of \d+)"),
    "faults": Figure("robot", "40 faults while moving: standstill", r"^(\d+ of \d+)"),
    "saved": Figure("planning", r"paper's arcs, --max-detour 8\.1: saved against RRT\*, not",
                    r"^(\S+ %), \+"),
    "longer": Figure("planning", r"paper's arcs, --max-detour 8\.1: saved against RRT\*, not",
                     r"^\S+ %, \+(\S+ %)"),
    "swing": Figure("worker", "modulus of generated branches from a noisy swing",
                    r"error (\S+ %) \(median\)"),
}

ROWS = (
    ("skeleton, radii and volume from a scan, with intervals",
     "six other generators, each left out of what was learnt: {other forks, one side} of the "
     "forks from one side, {other forks, around} from all around; radius bias {other bias, one "
     "side} and {other bias, around}; real scans against others' skeletons: length {real length} "
     "off (median), stated interval holds {real held}; 300 to 1,500 points, a generator without "
     "fitted constants: axes found / own {sparse}, length's interval holds {sparse held}; "
     "our own generator, one side: {forks} of the forks, radii {radius} off",
     "`tests/geometry`; `scripts/bench scans`"),
    ("bending and motion", "{elastica} off the elastica at worst, first frequency {frequency} off",
     "`tests/mechanics`; `scripts/bench mechanics`"),
    ("Young's modulus along the branch, with 95 % intervals",
     "a real beam's drop to {drop}; through scans of other generators: intervals of E I hold "
     "{stiffness held}, median error {stiffness}; of E {held}, worst piece {worst} off (median); "
     "exact data, worst error: {exact}",
     "`tests/estimation`; `scripts/bench estimation`, `truth`"),
    ("the gentlest path with a proven lower bound; limits that hold on the full model",
     "on arcs of the paper's size {saved} less energy than RRT*, {longer} longer (the paper: "
     "35.69 %, 8.10 %)", "`tests/planning`; `scripts/bench planning`"),
    ("recording and execution with a UR arm, under a guard", "on the virtual robot only",
     "`tests/robot` with the real client library; `scripts/bench robot`"),
    ("wind, snow, fruit, pruning; ringing and free swings",
     "our own generator: modulus from a noisy free swing {swing} off (median)",
     "`tests/mechanics`, `tests/estimation`; `scripts/bench worker`"),
    ("many branches, on one machine or a cluster", "", "`tests/batch`; `scripts/bench worker`"),
)


def figure(name: str) -> tuple[str, int]:
    """Return a figure, and the number of trials that it stands on.

    Raises:
        LookupError: the bench's table has no such row, was not run for it, or says it otherwise.
    """
    bench, measure, part, over_rows = FIGURES[name]
    rows = [row for row in record(bench)["rows"] if re.match(measure, row["measure"])]
    found = [re.search(part, row["measured"]) for row in rows]
    if not rows or not all(found) or not all(row["count"] for row in rows):
        raise LookupError(f"{bench}.json has no row {measure!r} with {part!r}")
    groups = [one.groups() for one in found if one is not None]
    count = sum(row["count"] for row in rows)
    return (groups[0][0] if over_rows is None else over_rows(groups)), count


def table() -> str:
    """Return the README's table."""
    rows = [f"| {what} | {filled(how)} | {shown} |" for what, how, shown in ROWS]
    return "\n".join(["| what | how well (trials of each figure) | shown by |", "|---|---|---|",
                      *rows])


def filled(how: str) -> str:
    """Put the figures into a text, each with the number of its trials."""
    names = [name for _, name, _, _ in Formatter().parse(how) if name]
    return how.format(**{name: "{} ({})".format(*figure(name)) for name in names})


def outcome() -> str:
    """Return what the commands have found on the example branch, a line each."""
    import limber

    found = limber.open(EXAMPLE).results
    made, field, plan = found["reconstruct"].values, found["energy"], found["plan:to-goal"]
    estimate = found["estimate"]
    moduli = ", ".join(f"{young:.2g} ({low:.2g} to {high:.2g})" for young, (low, high) in
                       zip(1e-6 * estimate.young, 1e-6 * estimate.interval, strict=True))
    lines = {
        "reconstruct": f"{made['branch_count']} branches, {made['length_m']:.2f} m, radii "
                       f"{1e3 * made['radius_min_m']:.1f} to {1e3 * made['radius_max_m']:.1f} mm, "
                       f"{made['tet_count']} tetrahedra",
        "estimate": f"E = {moduli} MPa, base to tip",
        "energy": f"{len(field.positions)} poses; the field is off by "
                  f"{100 * field.energy_error:.1f} % in energy, {100 * field.force_error:.1f} % in "
                  "force",
        "plan": f"{1e3 * plan.values['plan']['length_m']:.0f} mm, at most {plan.gap:.1f} % off "
                "the least cost",
    }
    return "\n".join(["```text", *(f"{name:12} {text}" for name, text in lines.items()), "```"])


PARTS = {f"<!-- Outcome: {_SAID}": outcome, f"<!-- Figures: {_SAID}": table}
"""What is written, by the mark that it follows."""


def write() -> None:
    """Put the parts behind the README's marks."""
    text = README.read_text(encoding="utf-8")
    for begin, part in PARTS.items():
        before, _, rest = text.partition(begin)
        text = f"{before}{begin}\n{part()}\n{END}{rest.partition(END)[2]}"
    README.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    write()
