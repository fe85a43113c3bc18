"""
The gentle path and the shortest one
====================================

Both paths lead the grasp from rest to the same goal, the shortest with up to 7.2 N, the gentle one
with up to 1.7 N. The branch is shown at rest (grey) and at the goal, coloured by strain.
"""

import matplotlib.pyplot as plt
from branch_pictures import GREY, Camera, draw_surface, frame, outer_faces, per_face
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize

import limber
from limber.core.constants import PATH_COLOURS
from limber.store import Branch
from limber.store.loading import load_branch

folder = "../../../blend_files/bending_branch"
plan = limber.open(folder).results["plan:to-goal"]
loaded = load_branch(Branch.open(folder))
grasp, state = loaded.marked_grasp("point"), None
for pose in plan.path:
    state = loaded.equilibrium(grasp, pose, start=state).require()
mesh, faces, camera = loaded.mesh, outer_faces(loaded.mesh), Camera(azimuth=60)
bent = mesh.nodes + state.displacement
strain = 100 * loaded.model.largest_principal_strains(state.displacement)

figure, axes = plt.subplots(figsize=(7, 5.5), layout="constrained")
scale = ScalarMappable(Normalize(0, strain.max()), "viridis")
draw_surface(axes, camera, mesh.nodes, faces, GREY, alpha=0.3)
draw_surface(axes, camera, bent, faces, scale.to_rgba(per_face(mesh, faces, strain))[:, :3])
for key, path, title in (("baseline", plan.shortest_path, "shortest path"),
                         ("plan", plan.path, "gentle path")):
    peak = plan.values[key]["peak_force_n"]
    assert round(peak, 1) == {"baseline": 7.2, "plan": 1.7}[key]
    axes.plot(*camera(path[:, :3])[0].T, lw=3, color=PATH_COLOURS[key],
              label=f"{title}: {peak:.1f} N at most")
frame(axes, camera, mesh.nodes, bent)
figure.legend(loc="outside lower center", ncols=2)
figure.colorbar(scale, ax=axes, label="largest principal strain [%]", shrink=0.8)
plt.show()
