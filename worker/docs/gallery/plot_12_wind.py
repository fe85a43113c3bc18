"""
A branch in the wind
====================

How far the tip of the branch moves, and what its largest strain is, in a steady wind from the side:
86 mm and 0.90 % at 10 m/s. At rest the strain is that of its own weight, 0.38 %. With the wind it
falls first, to 0.34 % at 4 m/s. The drag is that of bare wood.
"""

import shutil
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import limber

speeds = np.array([0, 2, 4, 6, 8, 10])
tips, strains = [], []
with tempfile.TemporaryDirectory() as place:
    copy = shutil.copytree("../../../blend_files/mature", Path(place, "mature.branch"))
    branch = limber.open(copy)
    for speed in speeds:
        found = branch.load(wind=(float(speed), 0, 0), quiet=True)
        tips.append(1e3 * np.linalg.norm(found.tip_displacement))
        strains.append(100 * found.greatest_strain)

assert round(tips[-1]) == 86
assert [round(strains[k], 2) for k in (0, 2, 5)] == [0.38, 0.34, 0.90]

figure, axes = plt.subplots(figsize=(7, 4), layout="constrained")
axes.plot(speeds, tips, "o-", color="#1b9e77")
axes.set(xlabel="wind [m/s]", ylabel="way of the tip [mm]", ylim=(0, None))
axes.yaxis.label.set_color("#1b9e77")
other = axes.twinx()
other.plot(speeds, strains, "s--", color="#7570b3")
other.set(ylabel="largest strain [%]", ylim=(0, None))
other.yaxis.label.set_color("#7570b3")
plt.show()
