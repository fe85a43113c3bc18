"""
Energy, force and strain along both paths
=========================================

All values are of the finite elements along the paths, not of the field that the planner searched.
"""

import matplotlib.pyplot as plt
import numpy as np

import limber
from limber.core.constants import PATH_COLOURS

folder = "../../../blend_files/bending_branch"
tables = {key: np.genfromtxt(f"{folder}/plans/{name}.csv", delimiter=",", names=True)
          for key, name in (("baseline", "to-goal-baseline"), ("plan", "to-goal"))}
plan = limber.open(folder).results["plan:to-goal"]

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
