"""The core in ten lines: bends a branch at its grasp and prints energy and force.

    python bend.py NAME.branch
"""

import sys

from limber.store import Branch
from limber.store.loading import load_branch

branch = load_branch(Branch.read(sys.argv[1]))
grasp = branch.marked_grasp("point")
for way in (0.005, 0.010, 0.015):  # along x [m]
    pose = grasp.rest_pose + [way, 0, 0, 0, 0, 0]
    result = branch.equilibrium(grasp, pose).require()
    print(f"{1e3 * way:.0f} mm: {result.energy:.4g} J, {result.reaction_force} N")
