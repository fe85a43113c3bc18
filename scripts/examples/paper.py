"""The paper, section by section, with its own settings: three branches from scan to compared paths.

    python paper.py [FOLDER] [--trials 10] [--branches young mature artificial]

Each branch is generated in the paper's size, scanned, and given the paper's moduli; from there on
it is unknown. What is done in FOLDER (default: paper) is kept. The guide's page on the paper says
where this differs from it.
"""

import argparse
from pathlib import Path

import numpy as np

import limber

# Name, E1 .. E4 [Pa] and Poisson's ratio of the paper's first table; length [m].
BRANCHES = {"young": ((8.21e6, 3.35e6, 1.82e6, 0.29e6), 0.382, 0.50),
            "mature": ((26.1e6, 9.13e6, 7.58e6, 1.04e6), 0.351, 0.60),
            "artificial": ((122e6, 86e6, 44e6, 16e6), 0.336, 0.70)}
SAVED, LONGER = 35.69, 8.10
"""The paper's means over its three branches [%]."""


def branch_of(name: str, folder: Path, trials: int) -> limber.Branch:
    """Take one branch through the sections of the paper's technical approach and experiments."""
    young, poisson, length = BRANCHES[name]
    seed = list(BRANCHES).index(name) + 1
    path = folder / f"{name}.branch"
    if not path.exists():
        scan = limber.generate(folder / f"{name}-scan", length=length, radius_root=0.008,
                               fork_count=0, seed=seed)
        # A: Laplacian contraction, radii as medians and clamped, generalised cylinders, fTetWild.
        limber.reconstruct(scan.cloud, path, radii="paper", radius_range=(0.005, 0.018),
                           mesher="ftetwild", mesh_spacing=4, poisson=poisson, density=50.0,
                           young=1e7)
    branch = limber.open(path)
    if "estimate" not in branch.results:
        # B: St. Venant-Kirchhoff, moved by the force of a pull that a camera follows.
        branch.virtual_pull(name="pull-1", young=young, drive="force", seed=seed)
        # C: Nelder-Mead over K = 4 control points, inverse distances between them.
        branch.estimate(method="nelder-mead", fractions=(0.2, 0.4, 0.6, 0.8),
                        field="inverse_distance")
    if "energy" not in branch.results:
        branch.energy_field()
    # D: RRT* and D-RRT* from random starts, on radial basis functions of the energy.
    branch.run("compare", trials=trials)
    return branch


def moduli(branch: limber.Branch, name: str) -> str:
    """One row of the paper's table of moduli [1e7 Pa], as found and as they were."""
    found = branch.results["estimate"]
    rows = zip(np.array(found.young) / 1e7, np.array(found.interval) / 1e7,
               np.array(BRANCHES[name][0]) / 1e7, strict=True)
    return f"{name:11} " + "  ".join(f"{value:.3f} ({low:.3f} to {high:.3f}; {true:.3f})"
                                     for value, (low, high), true in rows)


def paths(branch: limber.Branch, name: str) -> tuple[str, float, float]:
    """One row of the paper's table of paths, then energy saved and length added by D-RRT* [%]."""
    planners = branch.results["compare:planners"].values["planners"]
    plain, aware = (planners[f"{planner}, not smoothed"] for planner in ("RRT*", "D-RRT*"))
    gentle = planners["eikonal"]
    row = "  ".join(f"{each['length_m_mean']:.3f} m, {each['energy_sum_nmm_mean']:.1f} N mm"
                    for each in (plain, aware))
    saved, longer = aware["saved_percent"], aware["longer_percent"]
    return (f"{name:11} {row}  {longer:+.2f} %  {saved:.2f} %  (gentle path: "
            f"{gentle['longer_percent']:+.2f} %, {gentle['saved_percent']:.2f} %)", saved, longer)


def figure(branches: dict[str, limber.Branch], path: Path) -> None:
    """Draw the moduli as found (95 % intervals) and as they were, and energies of all paths."""
    import matplotlib.pyplot as plt

    sheet, axes = plt.subplots(2, len(branches), figsize=(4 * len(branches), 6), squeeze=False)
    for column, (name, branch) in zip(axes.T, branches.items(), strict=True):
        found = branch.results["estimate"]
        value, interval = np.array(found.young), np.array(found.interval)
        at = np.arange(1, len(value) + 1)
        column[0].errorbar(at, value, np.abs(interval.T - value), fmt="o", capsize=4, label="found")
        column[0].plot(at, BRANCHES[name][0], "k_", markersize=18, label="true")
        column[0].set(title=name, yscale="log", xticks=at, xlabel="control point, base to tip",
                      ylabel="Young's modulus [Pa]")
        planners = branch.results["compare:planners"].values["planners"]
        rows = [planners[key] for key in ("RRT*, not smoothed", "D-RRT*, not smoothed", "eikonal")]
        column[1].bar(["RRT*", "D-RRT*", "gentle"], [row["energy_sum_nmm_mean"] for row in rows],
                      yerr=[row["energy_sum_nmm_deviation"] or 0 for row in rows], capsize=4,
                      color=["0.6", "tab:orange", "tab:green"])
        column[1].set_ylabel("deformation energy [N mm]")
    axes[0, 0].legend()
    sheet.tight_layout()
    sheet.savefig(path, dpi=120)


def main() -> None:
    """Run the branches, print both tables and draw the figure."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", nargs="?", type=Path, default=Path("paper"))
    parser.add_argument("--trials", type=int, default=10)
    parser.add_argument("--branches", nargs="+", choices=BRANCHES, default=list(BRANCHES))
    asked = parser.parse_args()
    asked.folder.mkdir(parents=True, exist_ok=True)
    branches = {name: branch_of(name, asked.folder, asked.trials) for name in asked.branches}
    print("\nYoung's modulus E1 .. E4 [1e7 Pa]: found (95 % interval; the paper's, which is true)")
    for name, branch in branches.items():
        print(moduli(branch, name))
    print(f"\nRRT* and D-RRT* over {asked.trials} trials; D-RRT* is longer by, and saves")
    rows = [paths(branch, name) for name, branch in branches.items()]
    print("\n".join(row for row, _, _ in rows))
    saved, longer = (float(np.mean(part)) for part in list(zip(*rows, strict=True))[1:])
    print(f"mean        {longer:+.2f} %, {saved:.2f} %; the paper: +{LONGER:.2f} %, {SAVED:.2f} %")
    figure(branches, asked.folder / "paper.png")
    print(f"picture {asked.folder / 'paper.png'}")


if __name__ == "__main__":
    main()
