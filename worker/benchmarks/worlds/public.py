"""Scans with truth as plain files, on which any program can be scored.

``scripts/worlds FOLDER [--seed N] [--each N] [--limber]``: PLY scans, SWC truths and ``score.py``,
which needs no Limber. With ``--limber`` Limber's own results lie beside them and are scored.
"""

import argparse
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path

from benchmarks.scan_cases import ScanCase
from benchmarks.scan_scores import seen_part
from benchmarks.worlds import score
from benchmarks.worlds.sources import BARE_VIEWS, NEW, SOURCES, WORLDS, sparse_case
from limber.geometry.cloud.cloud import Cloud
from limber.geometry.reconstruction import reconstruct_cloud
from limber.geometry.settings import ReconstructSettings

ABOUT = """Scans of generated branches and small trees with truth, by Limber. Free of rights (CC0).

scans/KIND_SEED.ply   points [m], as a sensor would see them: noise, one side or all around
truth/KIND_SEED.swc   axes and radii [m] of the wood that the scan shows, in the scan's frame
score.py              python score.py RESULTS, a folder with your KIND_SEED.swc

Six published rules of growth and drooping branches; laser scanners, depth cameras, hand scanners
and photogrammetry; bare, in leaf, in pots; sparse_* have 300 to 1,500 points. Up and the root are
not given: a program finds them, or is told them by you, which please state.
Another seed gives other plants: state yours (this folder: {seed}).
"""


def kinds() -> dict[str, Callable[[int], ScanCase]]:
    """What makes a case of each kind, by its name, from a seed."""
    return {name.replace(":", "_"): make for name, make in WORLDS.items()} | {
        f"sparse_{source}_{view}": partial(sparse_case, source=source, view=view)
        for source in (NEW, *SOURCES) for view in BARE_VIEWS}


def write_case(name: str, case: ScanCase, folder: Path) -> None:
    """Write a scan and the truth of what it shows."""
    Cloud(case.points).write_ply(folder / "scans" / f"{name}.ply")
    wood = case.points if case.leaf is None else case.points[~case.leaf]
    seen_part(case.truth, wood).write_swc(folder / "truth" / f"{name}.swc", unit="m")


def solve(name: str, case: ScanCase, folder: Path) -> None:
    """Write the axes that Limber finds, told nothing; of a failure nothing."""
    made = reconstruct_cloud(Cloud(case.points), ReconstructSettings(leave_out=True, root="auto"))
    found = made.meshed.skeleton
    found.moved(made.alignment.undo(found.nodes)).write_swc(folder / f"{name}.swc", unit="m")


def main(arguments: list[str] | None = None) -> None:
    """Write the folder that the command line names."""
    parser = argparse.ArgumentParser(prog="scripts/worlds", description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seed", type=int, default=1, help="of the first plant of each kind")
    parser.add_argument("--each", type=int, default=1, help="plants of each kind")
    parser.add_argument("--limber", action="store_true", help="score Limber's own results too")
    parser.add_argument("--only", help="kinds with this in their name")
    typed = parser.parse_args(arguments)
    for part in ("scans", "truth", *(["limber"] if typed.limber else [])):
        (typed.folder / part).mkdir(parents=True, exist_ok=True)
    shutil.copy(score.__file__, typed.folder / "score.py")
    (typed.folder / "README.txt").write_text(ABOUT.format(seed=typed.seed), encoding="utf-8")
    for kind, make in kinds().items():
        if typed.only and typed.only not in kind:
            continue
        for seed in range(typed.seed, typed.seed + typed.each):
            name, case = f"{kind}_{seed}", make(seed)
            write_case(name, case, typed.folder)
            print(f"{name}: {len(case.points)} points", flush=True)
            if typed.limber:
                try:
                    solve(name, case, typed.folder / "limber")
                except Exception as error:
                    print(f"{name}: Limber failed: {error}", flush=True)
    if typed.limber:
        score.main(typed.folder / "limber", typed.folder / "truth")


if __name__ == "__main__":
    main()
