"""
Energy, force and strain along both paths
=========================================

All values are of the finite elements along the paths, not of the field that the planner searched.
The gentle path saves 34 % of the energy along the way; its largest strain is 1.5 %, not 2.0 %.
"""

import matplotlib.pyplot as plt
import numpy as np

import limber
from limber.core.constants import PATH_COLOURS

folder = "../../../blend_files/bending_branch"
tables = {key: np.genfromtxt(f"{folder}/plans/{name}.csv", delimiter=",", names=True)
          for key, name in (("baseline", "to-goal-baseline"), ("plan", "to-goal"))}
plan = limber.open(folder).results["plan:to-goal"]

assert round(plan.energy_saved) == 34
assert [round(100 * tables[key]["strain"].max(), 1) for key in ("plan", "baseline")] == [1.5, 2.0]

figure, rows = plt.subplots(3, 1, figsize=(7, 6.5), sharex=True, layout="constrained")
for key, title in (("baseline", "shortest path"), ("plan", "gentle path")):
    table = tables[key]
    for axes, column, factor in zip(rows, ("energy_j", "force_n", "strain"), (1e3, 1, 100),
                                    strict=True):
        axes.plot(1e3 * table["s_m"], factor * table[column], "o-", ms=4,
                  color=PATH_COLOURS[key], label=title)
for axes, label in zip(rows, ("energy [mJ]", "force [N]", "largest strain [%]"), strict=True):
    axes.set(ylabel=label, ylim=(0, None))
rows[0].legend()
rows[0].set_title(f"the gentle path saves {plan.energy_saved:.0f} % of the energy along the way")
rows[2].set_xlabel("way along the path [mm]")
plt.show()
