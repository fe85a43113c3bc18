"""The figures of the README: what commands say of an example, and how well each part does.

``scripts/make_readme_figures`` puts both between the README's marks; a test holds them there. A
figure of the table is a part of what a bench's row says, as `accuracy_page` keeps it.
"""

import re
from pathlib import Path
from string import Formatter
from typing import NamedTuple

from accuracy_page import record

README = Path(__file__).parents[2] / "README.md"
EXAMPLE = README.parent / "blend_files" / "bending_branch"
_SAID, END = "scripts/make_readme_figures writes this. -->", "<!-- End. -->"


class Figure(NamedTuple):
    """Where a figure comes from.

    Attributes:
        bench: Its name.
        measure: The beginning of its row's measure.
        part: A pattern with the figure as its group.
    """

    bench: str
    measure: str
    part: str


FIGURES = {
    "forks": Figure("scans", "one-sided, noise 1 mm: forks", r"^(\S+) "),
    "radius": Figure("scans", "one-sided, noise 1 mm: radius", r"median (\S+%)"),
    "volume": Figure("scans", "one-sided, noise 1 mm: mesh volume", r"^worst (\S+%)"),
    "elastica": Figure("mechanics", "cantilever against the elastica: own weight", r"^(\S+ %)"),
    "frequency": Figure("mechanics", "undamped free vibration", r"^(\S+ %)"),
    "exact": Figure("estimation", "three branches, one pull, exact", r"^(.*)$"),
    "round": Figure("estimation", "the same: error of E", r"round: median (\S+ %)"),
    "one-sided": Figure("estimation", "the same: error of E", r"one-sided: median (\S+ %)"),
    "drop": Figure("estimation", "silicone_beam: E from", r"\(-?(\S+ %)\)$"),
    "saved": Figure("worker", "limber demo: energy", r"^(\S+ %)"),
    "swing": Figure("worker", "modulus of generated branches from a noisy swing",
                    r"error (\S+ %) \(median\)"),
    "held": Figure("worker", "limber demo: 95 % intervals", r"^(\d of \d)"),
}

ROWS = (
    ("skeleton, radii and volume from a scan, with intervals",
     "from one side, 1 mm noise: {forks} of the forks, radii {radius} off (median), volume "
     "{volume} at worst", "`tests/geometry`; `scripts/bench scans`, `geometry`"),
    ("bending and motion", "{elastica} off the elastica at worst, first frequency {frequency} off",
     "`tests/mechanics`; `scripts/bench mechanics`"),
    ("Young's modulus along the branch, with 95 % intervals",
     "worst error on exact data: {exact}; through a scan: median {round} (all around), {one-sided} "
     "(one side); a real beam's drop to {drop}",
     "`tests/estimation`; `scripts/bench estimation`, `truth`"),
    ("the gentlest path with a proven lower bound; limits that hold on the full model",
     "in the demo {saved} less energy than the shortest path",
     "`tests/planning`; `scripts/bench planning`"),
    ("recording and execution with a UR arm, under a guard", "on the virtual robot only",
     "`tests/robot` with the real client library; `scripts/bench robot`"),
    ("wind, snow, fruit, pruning; ringing and free swings",
     "modulus from a noisy free swing: {swing} off (median)",
     "`tests/mechanics`, `tests/estimation`; `scripts/bench worker`"),
    ("many branches, on one machine or a cluster", "", "`tests/batch`; `scripts/bench worker`"),
)


def figure(name: str) -> tuple[str, int]:
    """Return a figure, and the number of trials that it stands on.

    Raises:
        LookupError: the bench's table has no such row, was not run for it, or says it otherwise.
    """
    bench, measure, part = FIGURES[name]
    for row in record(bench)["rows"]:
        if row["measure"].startswith(measure):
            found = re.search(part, row["measured"])
            if row["count"] and found:
                return found[1], row["count"]
    raise LookupError(f"{bench}.json has no row {measure!r} with {part!r}")


def table() -> str:
    """Return the README's table."""
    rows = [f"| {what} | {_filled(how)} | {shown} |" for what, how, shown in ROWS]
    return "\n".join(["| what | how well (trials) | shown by |", "|---|---|---|", *rows])


def _filled(how: str) -> str:
    """Put the figures in, and the least and the largest number of their trials behind them."""
    names = [name for _, name, _, _ in Formatter().parse(how) if name]
    if not names:
        return how
    found = {name: figure(name) for name in names}
    counts = sorted({count for _, count in found.values()})
    trials = "-".join(str(count) for count in dict.fromkeys((counts[0], counts[-1])))
    return how.format(**{name: text for name, (text, _) in found.items()}) + f" ({trials})"


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
        "plan": f"{1e3 * plan.values['plan']['length_m']:.0f} mm, {plan.energy_saved:.0f} % less "
                f"energy than the shortest path, at most {plan.gap:.1f} % off the least cost",
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
