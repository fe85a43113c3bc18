"""
Tetrahedra at a fork
====================

The 896 tetrahedra of a branch as they are solved: quadratic ones, of ten nodes each, swept along
the axes and joined at forks.
"""

import matplotlib.pyplot as plt
import numpy as np
from branch_pictures import Camera, draw_surface, frame, outer_faces

import limber

branch = limber.open("../../../blend_files/bending_branch")
mesh, camera = branch.mesh, Camera(azimuth=-5)
assert mesh.tets.shape == (896, 10)
faces = outer_faces(mesh)
axes_found = branch.skeleton
fork = axes_found.nodes[axes_found.parent[np.argmax(axes_found.order == 1)]]

figure, (whole, near) = plt.subplots(1, 2, figsize=(8, 5.5), layout="constrained")
for axes in (whole, near):
    draw_surface(axes, camera, mesh.nodes, faces, edges=True)
frame(whole, camera, mesh.nodes)
whole.set_title(f"{mesh.tet_count:,} tetrahedra, {mesh.node_count:,} nodes")
frame(near, camera, fork + 0.05 * np.array([[-1, 0, -1], [1, 0, 1.0]]))
near.set_title("at the first fork")
plt.show()
