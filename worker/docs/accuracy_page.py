"""The page "How right is it", from the benches' own tables.

``data/BENCH.json`` is the last line of ``scripts/bench BENCH --json``: rows with date, commit, seed
and count. Nothing is written here by hand but what each bench measures against.
"""

import datetime
import json
from contextlib import closing
from pathlib import Path
from typing import Any

DATA = Path(__file__).parent / "data"
URSIM = DATA / "ursim.jsonl"
"""A line for each run against the maker's simulator."""

CHAPTERS = {
    "scans": ("Skeletons, radii and volume", (
        "Branches with known axes and radii are generated and scanned with noise, gaps and uneven "
        "density, from all around, from one side or as one depth image. What is reconstructed is "
        "held against the truth. `real scans` are a coffee tree branch, an apple tree and a "
        "tomato seedling: there the truth is not known, so points and surface are compared.")),
    "worlds": ("Plants and sensors of other kinds", (
        "Six generators after published rules (space colonisation, L-systems, Weber and Penn, and "
        "others) share no code with the project's own. Models of laser scanners, depth cameras, "
        "hand scanners and photogrammetry see their plants bare, in leaf and in pots. Real scans "
        "come with skeletons of others.")),
    "sparse": ("Sparse scans, and other programs on them", (
        "Branches of 300 to 1,500 points with 2 to 3 mm noise and 1 to 3 % stray points, and real "
        "scans that are as sparse, or thinned. No constant was fitted on the generator "
        "`drooping`, but the search for the likeliest tree was designed looking at its scans of "
        "other seeds, and at both scans of puu. So neither is unseen. Each row says its seed and "
        "its commit: those of an earlier commit are of an earlier search. PyTLidar (TreeQSM "
        "in Python) and PC-skeletor get the same clouds, "
        "turned so that the true root is the lowest; Limber finds its root. Lengths, volumes and "
        "radii are medians, over the truth. The rows of the programs side by side are older than "
        "the others: Limber then took fewer proposals.")),
    "mechanics": ("Bending and motion", (
        "The finite elements against solutions that are known: rigid motions, the elastica by "
        "shooting, a manufactured solution for the order of convergence, a beam's frequency.")),
    "estimation": ("Young's modulus", (
        "Pulls are simulated on a finer mesh with known moduli and the noise of sensors, and the "
        "moduli are estimated from them. `silicone_beam` is a recording of a real beam under a "
        "weight.")),
    "truth": ("Young's modulus where more is wrong", (
        "As above, with all that a real cell does: wrong gain and zero of the force sensor, a "
        "gripper and a camera that are off, drift, scans instead of the true shape. The intervals "
        "must still hold the truth in 95 % of the cases.")),
    "planning": ("Energy, force and paths", (
        "The energy field on poses that it has not seen, the paths against an independent "
        "optimum, the limits on the full model, and the certified bound. Up to six jobs shared two "
        "cores, so the times of two at once are long. The rows of goals and of the paper's arcs "
        "are of commit f5a04b99; plans ended deeper in a region there.")),
    "robot": ("The robot", (
        "The real client library against the controller in software. No real robot was used.")),
    "worker": ("What a newcomer meets", (
        "`limber demo` on its generated branch, set-up aside: how long it takes, and what it "
        "finds. Where other work runs beside it, the clock says more than the processor time.")),
}
"""What each bench is about, in the page's order."""
COMMANDS = {"worlds": "scans --only worlds worlds-real",
            "sparse": "scans --only sparse sparse-real peers perturbations"}
"""How those are run that are a part of a bench."""


def record(bench: str) -> dict[str, Any]:
    """Return what a bench has found."""
    return json.loads((DATA / f"{bench}.json").read_text(encoding="utf-8"))


def accuracy_page() -> str:
    """Return the page as MyST."""
    parts = ["# How right is it\n", (
        "These tables are what the project's own benches have measured. `asked` is the limit that "
        "was set before, `met` compares the two, and `count` is the number of trials. A row that "
        "a run had no time for is not listed. The page is written from `worker/docs/data` by "
        "`scripts/docs`, and a test holds it to that.\n"), (
        "`scripts/bench NAME` measures anew, with fresh seeds. `--seed` repeats a run. Times are "
        "those of two shared cores. `scripts/worlds FOLDER` writes the scans of the other kinds, "
        "with their truth, as plain files. The score that lies beside them takes any program's "
        "skeletons.\n")]
    for bench, (title, about) in CHAPTERS.items():
        if (DATA / f"{bench}.json").is_file():
            parts.extend(_chapter(bench, title, about))
        if bench == "robot":
            parts.append(_ursim())
    parts += ["## What was not measured\n", (
        "Wood in the field: no modulus of a real plant was compared with a test in a laboratory. "
        "A real robot: nothing but the controller in software was moved. Leaves in the wind: the "
        "drag is that of bare wood.\n")]
    return "\n".join(parts)


def log_ursim(address: str, model: str, passed: bool) -> None:
    """Log a run of the tests against the maker's simulator there, for the page."""
    from limber.robot.ur.rtde import Dashboard

    with closing(Dashboard(address)) as dashboard, open(URSIM, "a", encoding="utf-8") as runs:
        runs.write(json.dumps({
            "date": datetime.date.today().isoformat(), "model": model,
            "version": dashboard.ask("PolyscopeVersion"), "passed": passed}) + "\n")


def _ursim() -> str:
    """Return when the maker's simulator was last asked, and what came of it."""
    runs = map(json.loads, URSIM.read_text(encoding="utf-8").splitlines())
    told = "; ".join(f"{run['date']}: {run['model']}, {run['version']}, "
                     f"{'passed' if run['passed'] else '**failed**'}" for run in runs)
    return (f"Universal Robots' own simulator (`LIMBER_URSIM=ADDRESS scripts/test "
            f"tests/robot/test_ursim.py`): {told or 'never run'}.\n")


def _chapter(bench: str, title: str, about: str) -> list[str]:
    found = record(bench)
    rows = [row for row in found["rows"] if row["count"]]
    date = datetime.date.fromisoformat(found["date"])
    missing = len(found["rows"]) - len(rows)
    told = (f"`scripts/bench {COMMANDS.get(bench, bench)} --seed {found['seed']}`, "
            f"{date:%-d %B %Y}, commit `{found['commit']}`, {found['budget_s'] / 60:.0f} minutes"
            + (f"; {missing} rows had no time" if missing else "") + ".\n")
    return [f"## {title}\n", f"{about}\n", told, "| measure | asked | measured | met | count |",
            "|---|---|---|---|---|", *map(_row, rows), ""]


def _row(row: dict[str, Any]) -> str:
    met = {True: "yes", False: "**no**", None: ""}[row["met"]]
    cells = (row["measure"], row["asked"], row["measured"], met, str(row["count"]))
    return "| " + " | ".join(cell.replace("|", "\\|").replace("<", "&lt;") for cell in cells) + " |"
