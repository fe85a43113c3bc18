"""
How sure the radii are
======================

The radius along the main path with its 95 % interval. Where the scan shows too little of the
bark, the radius comes from its neighbours and the interval widens.
"""

import matplotlib.pyplot as plt

import limber

skeleton = limber.open("../../../blend_files/mature").skeleton
path = skeleton.main_path()
along, radius = 1e3 * skeleton.arc_length[path], 1e3 * skeleton.radius[path]
margin = 1e3 * 1.96 * skeleton.radius_sigma[path]

figure, axes = plt.subplots(figsize=(7, 4), layout="constrained")
axes.fill_between(along, radius - margin, radius + margin, color="#b5401e", alpha=0.25, lw=0,
                  label="95 % interval")
axes.plot(along, radius, color="#b5401e", label="radius")
axes.set(xlabel="distance from the base along the main path [mm]", ylabel="radius [mm]",
         ylim=(0, None))
axes.legend()
plt.show()
