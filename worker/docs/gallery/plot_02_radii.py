"""
How sure the radii are
======================

The radius along the main path with its 95 % interval. Where the bark shows, the interval is
3.7 % to either side (median). Where the scan shows too little of it, the radius comes from its
neighbours, and the interval is 49 %.
"""

import matplotlib.pyplot as plt
import numpy as np

import limber
from limber.geometry.skeleton.skeleton import MEASURED

skeleton = limber.open("../../../blend_files/mature").skeleton
path = skeleton.main_path()
along, radius = 1e3 * skeleton.arc_length[path], 1e3 * skeleton.radius[path]
margin = 1e3 * 1.96 * skeleton.radius_sigma[path]
is_seen = skeleton.radius_state[path] == MEASURED
assert round(100 * np.median((margin / radius)[is_seen]), 1) == 3.7
assert round(100 * np.median((margin / radius)[~is_seen])) == 49

figure, axes = plt.subplots(figsize=(7, 4), layout="constrained")
axes.fill_between(along, radius - margin, radius + margin, color="#b5401e", alpha=0.25, lw=0,
                  label="95 % interval")
axes.plot(along, radius, color="#b5401e", label="radius")
axes.set(xlabel="distance from the base along the main path [mm]", ylabel="radius [mm]",
         ylim=(0, None))
axes.legend()
plt.show()
