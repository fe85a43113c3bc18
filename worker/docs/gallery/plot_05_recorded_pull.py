"""
What a recorded pull holds
==========================

Force of the gripper and way of the grasp over time, and the ways of four observed points. The
grasp goes 141 mm; the force reaches 0.29 N. This pull is simulated, with the noise of sensors.
"""

import matplotlib.pyplot as plt
import numpy as np

import limber

pull = limber.open("../../../blend_files/mature").pulls["pull-1"]
way = 1e3 * np.linalg.norm(pull.poses[:, :3] - pull.poses[0, :3], axis=1)
seen = 1e3 * np.linalg.norm(pull.markers - pull.markers[0], axis=2)
assert (round(way.max()), seen.shape[1]) == (141, 4)
assert round(np.linalg.norm(pull.forces, axis=1).max(), 2) == 0.29

figure, (top, bottom) = plt.subplots(2, 1, figsize=(7, 5.5), sharex=True, layout="constrained")
for axis, force in zip("xyz", pull.forces.T, strict=True):
    top.plot(pull.times, force, label=f"force, {axis}")
top.set(ylabel="force on the branch [N]")
top.legend(loc="upper left")
bottom.plot(pull.marker_times, seen, color="#888888", lw=1)
bottom.plot(pull.times, way, color="#e08214", lw=2.5, label="grasp")
bottom.plot([], [], color="#888888", lw=1, label=f"{seen.shape[1]} observed points")
bottom.set(xlabel="time [s]", ylabel="way from rest [mm]")
bottom.legend(loc="upper left")
plt.show()
