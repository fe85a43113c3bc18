"""
Young's modulus along three plants
==================================

Three generated plants with the moduli of the paper's branches, coloured by the moduli that were
estimated from a simulated pull. One scale, so that they can be compared: the young plant is 617
times softer at its tip than the artificial one at its base.
"""

import matplotlib.pyplot as plt
import numpy as np
from branch_pictures import Camera, draw_surface, frame, outer_faces, per_face
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm

import limber

scale = ScalarMappable(LogNorm(0.3, 120), "viridis")
extremes = {}
figure, row = plt.subplots(1, 3, figsize=(8.5, 5), layout="constrained")
for axes, name in zip(row, ("young", "mature", "artificial"), strict=True):
    mesh = limber.open(f"../../../blend_files/{name}").mesh
    faces = outer_faces(mesh)
    extremes[name] = np.array([mesh.cell_data["young"].min(), mesh.cell_data["young"].max()])
    colours = scale.to_rgba(per_face(mesh, faces, 1e-6 * mesh.cell_data["young"]))[:, :3]
    camera = Camera(azimuth=-20)
    draw_surface(axes, camera, mesh.nodes, faces, colours)
    frame(axes, camera, mesh.nodes)
    axes.set_title(name)
assert round(extremes["artificial"][1] / extremes["young"][0]) == 617
figure.colorbar(scale, ax=row, label="Young's modulus [MPa]", shrink=0.8)
plt.show()
