"""Space colonisation (Runions, Lane, Prusinkiewicz 2007): axes compete for points in the crown."""

import numpy as np
from scipy.spatial import cKDTree

from benchmarks.worlds.plant import Growth, Plant, pipe_radii

_STEP = 0.012  # [m] that an axis grows in one turn
_REACH, _TAKEN = 0.25, 0.05  # [m]: influence and kill distance of attraction points
_TURNS = 160


def colonised(rng: np.random.Generator) -> Plant:
    """A small tree in an ellipsoid of attraction points, thick by the pipe model."""
    height = rng.uniform(0.6, 0.9)
    spread = rng.normal(size=(int(rng.integers(45, 90)), 3))
    spread *= (rng.uniform(size=len(spread))**(1 / 3) / np.linalg.norm(spread, axis=1))[:, None]
    wanted = spread * [0.4 * height, 0.3 * height, 0.5 * height] + [0, 0, 0.8 * height]
    growth = Growth(np.zeros(3))
    for _ in range(_TURNS):
        nodes = np.array(growth.nodes)
        distance, near = cKDTree(nodes).query(wanted)
        drawn = distance < max(_REACH, distance.min(initial=np.inf) * 1.01)
        pull = np.zeros_like(nodes)
        np.add.at(pull, near[drawn], (wanted[drawn] - nodes[near[drawn]]) / np.maximum(
            distance[drawn], 1e-9)[:, None])
        grown = 0
        for node in np.unique(near[drawn]):
            way = pull[node] + 0.02 * rng.normal(size=3)
            place = nodes[node] + _STEP * way / np.linalg.norm(way)
            if cKDTree(np.array(growth.nodes)).query(place)[0] > 0.5 * _STEP:
                growth.add(place, int(node))
                grown += 1
        wanted = wanted[cKDTree(np.array(growth.nodes)).query(wanted)[0] > _TAKEN]
        if not grown or not len(wanted):
            break
    tip, power = rng.uniform(0.0018, 0.0026), rng.uniform(2.1, 2.8)
    growth.radius = list(pipe_radii(np.array(growth.parent), tip, power))
    return growth.plant()
