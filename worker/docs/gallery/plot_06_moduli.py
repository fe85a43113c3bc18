"""
Estimated moduli beside the true ones
=====================================

What one simulated pull says about Young's modulus at four control points, with 95 % intervals. The
crosses are the moduli that the pulls were simulated with. All 12 lie in their intervals; the worst
estimate is off by a factor of 1.5.
"""

import matplotlib.pyplot as plt
import numpy as np

import limber

# The moduli that `scripts/make_blend_files` simulates the pulls with [Pa], base to tip.
true = {"young": (8.21e6, 3.35e6, 1.82e6, 2.9e5), "mature": (2.61e7, 9.13e6, 7.58e6, 1.04e6),
        "artificial": (1.22e8, 8.6e7, 4.4e7, 1.6e7)}
colours = {"young": "#1b9e77", "mature": "#7570b3", "artificial": "#d95f02"}

held, worst = 0, 0.0
figure, axes = plt.subplots(figsize=(7, 4.5), layout="constrained")
for k, (name, moduli) in enumerate(true.items()):
    found = limber.open(f"../../../blend_files/{name}").results["estimate"]
    low, high = found.interval.T
    held += int(((low < moduli) & (moduli < high)).sum())
    worst = max(worst, np.abs(np.log(found.young / moduli)).max())
    at = found.fractions + 0.012 * (k - 1)
    margins = np.abs(found.interval.T - found.young)
    axes.errorbar(at, 1e-6 * found.young, 1e-6 * margins, fmt="o", ms=5, capsize=4,
                  color=colours[name], label=name)
    axes.plot(at, 1e-6 * np.array(moduli), "kx", ms=8, label="true" if k == 2 else None)
assert held == 12 and round(np.exp(worst), 1) == 1.5
axes.set(yscale="log", xlabel="place along the main path, 0 base to 1 tip",
         ylabel="Young's modulus [MPa]")
axes.legend()
plt.show()
