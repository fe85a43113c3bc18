"""Cases of all worlds by name: a plant, dressed, seen by a sensor; each draws all of its seed.

No constant of the program was set on any of them alone. Once one is, its source leaves
``LEFT_OUT``. How far forks are off the pipe model (`radii/wood.py`) is learnt over all of them and
the project's own; with each left out it changes by a tenth to a quarter.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.scan_cases import ScanCase
from benchmarks.worlds import sensors
from benchmarks.worlds.plants import (
    Plant,
    colonised,
    dichotomous,
    drooping,
    monopodial,
    opposite,
    sympodial,
    weber_penn,
)
from benchmarks.worlds.sensors import ALL_AROUND, ONE_SIDED, Scene, Seen

SOURCES: dict[str, Callable[[np.random.Generator], Plant]] = {
    "colonisation": colonised, "monopodial": monopodial, "sympodial": sympodial,
    "opposite": opposite, "dichotomous": dichotomous, "weber-penn": weber_penn}
LEFT_OUT = frozenset(SOURCES)
"""Sources that no constant was set on alone."""
NEW = "drooping"
"""Source of which no program's constant and no fit has seen a scan."""
_STREAM = 35  # separates these draws from those of other cases of a seed
BARE_VIEWS = ("one-sided", "round")


def bare_case(seed: int, source: str, view: str) -> ScanCase:
    """A bare plant from one side, noise 1 or 2 mm, or from all around, 0.5 to 1 mm."""
    rng = _generator(seed, source, view)
    plant = SOURCES[source](rng)
    one_sided = view == "one-sided"
    sensor = rng.choice(ONE_SIDED if one_sided else ALL_AROUND)
    noise = (0.001, 0.002)[seed % 2] if one_sided else rng.uniform(0.0005, 0.001)
    return _case(f"{source}_{view}_{seed}", seed, plant,
                 sensor(Scene.bare(plant), rng, noise), {"leave_out": True})


def branch_case(seed: int, source: str, view: str, noise: float) -> ScanCase:
    """A branch cut from a bare plant, as it hangs in a robot's cell; ``noise`` in metres."""
    rng = _generator(seed, source, view, "branch")
    plant = SOURCES[source](rng).branch()
    sensor = rng.choice(ONE_SIDED if view == "one-sided" else ALL_AROUND)
    return _case(f"{source}_{view}_{seed}", seed, plant,
                 sensor(Scene.bare(plant), rng, noise), {"leave_out": True})


def thinned_case(seed: int) -> ScanCase:
    """A bare plant, or every other time a branch that hangs any way round, of 400 to 20,000 points.
    """
    rng = np.random.default_rng([seed, _STREAM])
    source, view = rng.choice(list(SOURCES)), rng.choice(BARE_VIEWS)
    case = (branch_case(seed, source, view, 0.001) if seed % 2 else bare_case(seed, source, view))
    points = rng.permutation(case.points)[:int(400 * 50**rng.uniform())]
    up = Rotation.random(rng=rng).as_matrix()[0] if seed % 2 else case.settings["up"]
    return replace(case, points=points, settings=case.settings | {"up": tuple(up)})


def leafy_case(seed: int, source: str) -> ScanCase:
    """A plant in leaf from all around; its user asks to cut leaves."""
    rng = _generator(seed, source, "leafy")
    plant = SOURCES[source](rng)
    seen = rng.choice(ALL_AROUND)(sensors.leafy(plant, rng), rng, 0.0005)
    return _case(f"{source}_leafy_{seed}", seed, plant, seen,
                 {"leave_out": True, "leaves": "cut"}, seen.label == sensors.LEAF)


def sparse_case(seed: int, source: str, view: str) -> ScanCase:
    """300 to 1,500 points of a branch, noise 2 to 3 mm, and 1 to 3 % of points anywhere."""
    rng = _generator(seed, source, view, "sparse")
    plant = drooping(rng) if source == NEW else SOURCES[source](rng).branch()
    sensor = rng.choice(ONE_SIDED if view == "one-sided" else ALL_AROUND)
    seen = sensor(Scene.bare(plant), rng, rng.uniform(0.002, 0.003))
    count = int(np.exp(rng.uniform(*np.log([300, 1500]))))
    points = seen.points[rng.permutation(len(seen.points))[:count]]
    stray = rng.uniform(points.min(axis=0), points.max(axis=0), (
        round(rng.uniform(0.01, 0.03) * count), 3))
    case = _case(f"sparse_{source}_{view}_{seed}", seed, plant, seen, {"leave_out": True})
    return replace(case, points=np.concatenate([points, stray]), leaf=np.repeat(
        [False, True], [len(points), len(stray)]))


def _generator(seed: int, *words: str) -> np.random.Generator:
    return np.random.default_rng([seed, _STREAM, *"".join(words).encode()])


def _case(name: str, seed: int, plant: Plant, seen: Seen, settings: dict,
          not_wood: np.ndarray | None = None) -> ScanCase:
    skeleton = plant.skeleton
    up = tuple((seen.turn @ [0.0, 0.0, 1.0]).tolist())
    return ScanCase(name, seed, skeleton.moved(seen.placed(skeleton.nodes)), seen.points,
                    plant.volume(), settings | {"up": up}, not_wood)


WORLDS: dict[str, Callable[[int], ScanCase]] = {
    **{f"{source}:{view}": partial(bare_case, source=source, view=view)
       for view in BARE_VIEWS for source in SOURCES},
    **{f"{source}:leafy": partial(leafy_case, source=source) for source in SOURCES}}
"""Cases by source and view, from a seed."""
