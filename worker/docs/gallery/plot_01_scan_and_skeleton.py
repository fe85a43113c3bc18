"""
A scan and the axes found in it
===============================

The scan of a branch with two forks, 756 points with noise and gaps, and the three axes that
`limber reconstruct` found in it, 0.72 m together. A circle shows the radius at each node.
"""

import matplotlib.pyplot as plt
import numpy as np
from branch_pictures import Camera, draw_axes, frame
from matplotlib.collections import EllipseCollection
from plyfile import PlyData

import limber

folder = "../../../blend_files/bending_branch"
branch = limber.open(folder)
vertex = PlyData.read(f"{folder}/cloud.ply")["vertex"]
scan = np.column_stack([vertex[axis] for axis in "xyz"]).astype(float)
length = branch.results["reconstruct"].values["length_m"]
assert (len(scan), branch.skeleton.branch_count, round(length, 2)) == (756, 3, 0.72)

camera = Camera(azimuth=-5)
figure, (left, right) = plt.subplots(1, 2, figsize=(8, 5.5), layout="constrained")
flat, depth = camera(scan)
left.scatter(*flat.T, s=6, c=depth, cmap="bone", vmax=0.3, lw=0)
left.set_title(f"scan: {len(scan)} points")

right.scatter(*flat.T, s=5, color="#c9c4ba", lw=0)
draw_axes(right, camera, branch.skeleton)
middles, _ = camera(branch.skeleton.nodes)
sizes = 2 * branch.skeleton.radius
right.add_collection(EllipseCollection(
    sizes, sizes, 0, units="xy", offsets=middles, facecolor="none", edgecolor="#b5401e", lw=0.5,
    offset_transform=right.transData))
right.set_title(f"{branch.skeleton.branch_count} axes, {length:.2f} m, and radii")
for axes in (left, right):
    frame(axes, camera, scan)
plt.show()
