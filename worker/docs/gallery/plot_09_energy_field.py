"""
The energy field
================

Deformation energy over the position of the grasp, in the vertical plane of the branch. The valley
is where the branch bends without being stretched; the cross is the grasp at rest, where the energy
is 0. The six white dots are the solved poses near that plane.
"""

import matplotlib.pyplot as plt
import numpy as np

import limber

field = limber.open("../../../blend_files/mature").results["energy"]
rest, spread = field.positions[0], np.abs(field.positions - field.positions[0]).max(0)
across = np.linspace(-spread[0], spread[0], 161)
up = np.linspace(-spread[2], 0.4 * spread[2], 121)
points = np.stack([*np.meshgrid(rest[0] + across, [rest[1]], rest[2] + up, indexing="ij")], -1)
energy = 1e3 * field.energy(points.reshape(-1, 3)).reshape(161, 121)

figure, axes = plt.subplots(figsize=(7.5, 3.4), layout="constrained")
levels = [0, 2, 5, 10, 20, 50, 100, 200, 500]
filled = axes.contourf(1e3 * (rest[0] + across), 1e3 * (rest[2] + up), energy.T, levels,
                       cmap="viridis", extend="max", norm="symlog")
near = np.abs(field.positions[:, 1] - rest[1]) < 0.15 * spread[1]
assert near.sum() == 6 and abs(field.energy(rest[None])[0]) < 1e-9
axes.plot(*(1e3 * field.positions[near][:, [0, 2]]).T, ".", color="white", ms=6,
          label="solved poses")
axes.plot(1e3 * rest[0], 1e3 * rest[2], "x", color="#e08214", ms=11, mew=3, label="at rest")
axes.set(xlabel="x [mm]", ylabel="z [mm]", aspect="equal")
axes.legend(loc="lower left", facecolor="#555555", labelcolor="white")
figure.colorbar(filled, label="energy [mJ]", ticks=levels, shrink=0.9)
plt.show()
