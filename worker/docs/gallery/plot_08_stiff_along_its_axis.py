"""
Why a straight pull is not gentle
=================================

A branch is stiff along its axis. A grasp that goes aside in a straight line stretches the branch;
one that follows the arc of least energy does not. At 80 mm the straight line needs 96 times the
force. The scale of forces is logarithmic.
"""

import matplotlib.pyplot as plt
import numpy as np

import limber
from limber.store import Branch
from limber.store.loading import load_branch

folder = "../../../blend_files/mature"
field = limber.open(folder).results["energy"]
loaded = load_branch(Branch.open(folder))
grasp = loaded.marked_grasp("point")
rest = grasp.rest_pose
base = loaded.mesh.nodes[loaded.mesh.point_data["fixed"] > 0].mean(0)
arm = rest[:3] - base
across = np.cross(arm, [0.0, 1.0, 0.0])
across /= np.linalg.norm(across)

ways = np.linspace(0.005, 0.08, 8)
last = []
figure, axes = plt.subplots(figsize=(7, 4.5), layout="constrained")
for label, colour in (("straight line", "#1965ce"), ("arc of least energy", "#e52145")):
    forces, state = [], None
    for way in ways:
        pose = rest.copy()
        pose[:3] += way * across
        if label != "straight line":
            tried = base + np.linspace(0.93, 1.01, 161)[:, None] * (pose[:3] - base)
            pose[:3] = tried[np.argmin(field.energy(tried))]
        state = loaded.equilibrium(grasp, pose, start=state).require()
        forces.append(np.linalg.norm(state.reaction_force))
    last.append(forces[-1])
    axes.semilogy(1e3 * ways, forces, "o-", color=colour, label=label)
assert round(last[0] / last[1]) == 96
axes.set(xlabel="way aside [mm]", ylabel="force of the gripper [N]")
axes.legend()
plt.show()
