"""
A branch bent step by step
==========================

Equilibria with the grasp led aside by up to 24 degrees, coloured by the largest principal strain,
which reaches 3.1 %. The grasp holds a position and leaves the branch free to turn in it. At each
step it keeps the distance from the base that costs the least energy; the last force is 1.18 N.
"""

import matplotlib.pyplot as plt
import numpy as np
from branch_pictures import Camera, draw_surface, frame, outer_faces, per_face
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize

import limber
from limber.store import Branch
from limber.store.loading import load_branch

folder = "../../../blend_files/mature"
field = limber.open(folder).results["energy"]
loaded = load_branch(Branch.open(folder))
grasp = loaded.marked_grasp("point")
mesh, faces = loaded.mesh, outer_faces(loaded.mesh)

base = mesh.nodes[mesh.point_data["fixed"] > 0].mean(0)
arm = grasp.rest_pose[:3] - base
scale, camera = ScalarMappable(Normalize(0, 4), "viridis"), Camera(azimuth=-5)
figure, axes = plt.subplots(figsize=(7, 5.5), layout="constrained")
shapes, state = [], None
for angle in np.radians([0, 8, 16, 24]):
    turned = [arm[0] * np.cos(angle) + arm[2] * np.sin(angle), arm[1],
              arm[2] * np.cos(angle) - arm[0] * np.sin(angle)]
    tried = base + np.linspace(0.93, 1.01, 161)[:, None] * turned
    pose = grasp.rest_pose.copy()
    if angle:
        pose[:3] = tried[np.argmin(field.energy(tried))]
    state = loaded.equilibrium(grasp, pose, start=state).require()
    strain = 100 * loaded.model.largest_principal_strains(state.displacement)
    shapes.append(mesh.nodes + state.displacement)
    draw_surface(axes, camera, shapes[-1], faces,
                 scale.to_rgba(per_face(mesh, faces, strain))[:, :3])
    place = camera(state.pose[None, :3])[0][0]
    axes.plot(*place, "o", ms=10, mfc="none", mec="#e08214", mew=2)
    tip = camera(shapes[-1])[0][np.argmax(np.linalg.norm(shapes[-1] - base, axis=1))]
    axes.annotate(f"{np.linalg.norm(state.reaction_force):.2f} N", tip, xytext=(6, 4),
                  textcoords="offset points")
assert round(strain.max(), 1) == 3.1
assert round(np.linalg.norm(state.reaction_force), 2) == 1.18
frame(axes, camera, *shapes)
figure.colorbar(scale, ax=axes, label="largest principal strain [%]", shrink=0.8)
plt.show()
