"""Trains the odds that parts of a scan are pots, stakes, wires or ground, on scenes with
truth, and measures them on sources left out.

``python -m benchmarks.part_training`` makes scenes of each source of plants, writes the weights of
:mod:`limber.geometry.cloud.surroundings`, fitted to all sources but those left out, and prints how
many parts of each kind are found there, and how many are called one falsely.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import expit

from benchmarks.leaf_training import LEFT_OUT
from benchmarks.scan_probabilities import OWN, fitted
from benchmarks.worlds import sensors
from benchmarks.worlds.plants import Plant, sheet_triangles
from benchmarks.worlds.sensors import ALL_AROUND, ONE_SIDED, Scene
from benchmarks.worlds.sources import SOURCES
from limber.geometry.cloud import surroundings
from limber.geometry.cloud.surroundings import MODEL, Part
from limber.geometry.generated import generate_branch
from limber.geometry.settings import OPEN

_UP = np.array([0.0, 0.0, 1.0])
_KINDS = ("pot", "stake", "wire", "ground")
# Overlap over union of a part that is the thing, of one that is more so than not, and of none.
_ALL, _HALF, _NONE = 0.9, 0.5, 0.2
# Fractions of scenes without things, of these of the plant alone, and of plants that hang any way.
_BARE, _PLAIN, _TURNED = 0.5, 0.5, 0.3
_SEEDS, _STREAM, _SPARSE, _DENSE = range(1, 51), 77, 300, 60_000


@dataclass(frozen=True)
class Scan:
    """Points [m], shape [n, 3], z up, on which thing each is, shape [n], and the things' kinds; the
    first is the plant, which is upright, hangs, or grows flat as on a trellis."""

    points: np.ndarray
    thing: np.ndarray
    kinds: tuple[str, ...]

    def without(self, *kinds: str) -> "Scan":
        kept = ~np.isin(self.kinds, kinds)[self.thing]
        return Scan(self.points[kept], self.thing[kept], self.kinds)

    def overlap(self, part: Part) -> float:
        """The most that a part and one thing of its kind have in common, over their union; a piece
        of one is not none."""
        inside, whole = (np.bincount(of, minlength=len(self.kinds)) for of in (
            self.thing[part.points], self.thing))
        own, count = np.isin(self.kinds, MODEL.get(part.kind, part.kind)), len(part.points)
        return float(np.max((inside / (count + whole - inside))[own],
                            initial=min(inside[own].sum() / count, _NONE)))


def scene(seed: int, source: str) -> Scan:
    """A plant among things, as a sensor sees them; half of the scans are thinned, to as few as 300
    points of the plant."""
    rng = np.random.default_rng([seed, _STREAM, *source.encode()])
    plant = _plant(rng, source)
    plant = plant.branch() if rng.uniform() < 0.3 else plant
    is_bare = rng.uniform() < _BARE
    flat = rng.choice([1.0, rng.uniform(0.0, 0.1)])  # as on a trellis: twigs beside each other
    turn = Rotation.random(rng=rng) if rng.uniform() < _TURNED else Rotation.identity()
    plant = replace(plant, nodes=turn.apply(plant.nodes * [1.0, 1.0 if is_bare else flat, 1.0]))
    made, kinds = Scene.bare(plant), ["plant"]
    for kind, triangles in () if is_bare and rng.uniform() < _PLAIN else _things(
            rng, plant.nodes.min(axis=0), plant.nodes.max(axis=0)):
        if is_bare and kind != "plant":
            continue
        made = made.plus(triangles, 0 if kind == "plant" else len(kinds))
        kinds += [kind] if kind != "plant" else []
    sensor = rng.choice((*ONE_SIDED, *ALL_AROUND, sensors.strewn))
    seen = sensor(made, rng, 0.0002 * 10**rng.uniform())
    some = rng.uniform(size=len(seen.label)) < min(_DENSE / len(seen.label), (
        _SPARSE / max((seen.label == 0).sum(), _SPARSE))**rng.choice([rng.uniform(), 0.0]))
    return Scan((seen.points @ seen.turn)[some], seen.label[some], tuple(kinds))


def _plant(rng: np.random.Generator, source: str) -> Plant:
    if source != OWN:
        return SOURCES[source](rng)
    thick = rng.uniform(0.003, 0.013)
    grown = generate_branch(
        int(rng.integers(1 << 31)), length=rng.uniform(0.3, 1.2), radius_root=thick,
        radius_tip=thick * rng.uniform(0.3, 1.0), bend=rng.choice([0.0, rng.uniform()]),
        fork_count=int(rng.integers(0, 6))).skeleton
    return Plant(grown.nodes, grown.parent, grown.radius)


def _things(rng: np.random.Generator, low: np.ndarray, high: np.ndarray,
            ) -> Iterator[tuple[str, np.ndarray]]:
    """Things around a plant in a box [m], by kind: triangles [m], shape [t, 3, 3]. What a plant has
    that is like them counts as the plant: shoots that thin or bend, large leaves, a dense crown."""
    size, tall, middle = float((high - low).max()), float(high[2] - low[2]), (low + high) / 2
    foot = np.array([*middle[:2], low[2]])
    if rng.uniform() < 0.4:
        wide, deep, soil = rng.uniform([0.04, 0.8, -0.02], [0.1, 2.2, 0.01])
        yield "pot", sensors.revolved(foot, [
            (rng.uniform(0.6, 0.95) * wide, -deep * wide), (wide, 0.02), (0.93 * wide, 0.02),
            (0.9 * wide, soil), (0.0, soil)])
    for kind in rng.choice(["stake", "plant"], rng.integers(0, 4)):
        thick = rng.uniform(0.003, 0.012) if rng.uniform() < 0.8 else rng.uniform(0.02, 0.04)
        yield kind, _rod(kind, foot + [*rng.uniform(-0.3, 0.3, 2) * size, -0.02], tall * (
            rng.uniform(0.5, 1.1)) * np.array([*rng.normal(0, 0.06, 2), 1.0]), 0.0, thick, rng)
    for kind in rng.choice(["wire", "plant"], rng.choice([0, 1, 3])):
        angle, sag = rng.uniform(0, np.pi), rng.choice([0.0, rng.uniform(0, 0.06)])
        along = rng.uniform(1.3 if kind == "wire" else 0.4, 2.0) * size * np.array(
            [np.cos(angle), np.sin(angle), rng.normal(0, 0.05)])
        yield kind, _rod(kind, middle + [0, 0, rng.uniform(-0.3, 0.4) * tall] - along / 2, along,
                         sag if kind == "wire" else -sag, rng.uniform(0.001, 0.002), rng)
    angle, (wide, high_wall) = rng.uniform(0, 2 * np.pi), size * rng.uniform(0.8, 1.8, 2)
    aside = np.array([np.cos(angle), np.sin(angle), 0.0])
    if rng.uniform() < 0.35:
        yield "sheet", _sheet(middle + rng.uniform(0.15, 0.6) * size * np.cross(aside, _UP),
                              wide * aside, high_wall * _UP, 0.0, rng)
    if rng.uniform() < 0.5:
        yield "ground", _sheet(foot, wide * np.array([1.0, 0.0, rng.uniform(0, 0.6)]), wide * (
            np.array([0.0, 1.0, 0.0])), rng.choice([0.0, rng.uniform(0.002, 0.03)]) * size, rng)
    for _ in range(int(rng.choice([0, 2, 5]))):
        along, across = rng.normal(0, 0.12, (2, 3)) * size
        yield "plant", _sheet(rng.uniform(low, high), along, across, 0.03 * size, rng)
    if rng.uniform() < 0.3:
        yield "plant", rng.uniform(middle - 0.5 * size, middle + [0.5, 0.5, rng.uniform(
            -0.4, 0.5)] * np.array(size), (9000, 1, 3)) + rng.normal(0, 0.003, (9000, 3, 3))


def _rod(kind: str, start: np.ndarray, along: np.ndarray, sag: float, thick: float,
         rng: np.random.Generator) -> np.ndarray:
    """A rod ``thick`` [m] at ``start`` [3] [m], which hangs by ``sag`` over its length; as a part
    of the plant it thins, bends aside, or both."""
    share, long = np.linspace(0, 1, 25), float(np.linalg.norm(along))
    thin, bend = rng.uniform(0.97, 1.03), 0.0
    if kind == "plant":
        thin, bend = ((rng.uniform(0.1, 0.6), 0.0), (rng.uniform(0.1, 0.6), rng.uniform(0, 0.15)), (
            thin, rng.uniform(0.04, 0.15)))[rng.integers(3)]
    bow = long * (sag * _UP + bend * np.cross(along, rng.normal(size=3)) / long)
    return Plant(start + share[:, None] * along + 4 * (share**2 - share)[:, None] * bow,
                 np.arange(-1, 24), thick * (1 + (thin - 1) * share)).skin()


def _sheet(middle: np.ndarray, along: np.ndarray, across: np.ndarray, bump: float,
           rng: np.random.Generator) -> np.ndarray:
    """A parallelogram around ``middle`` [3] [m] with waves up to ``bump`` [m] high."""
    grid = np.stack(np.meshgrid(*2 * [np.linspace(-0.5, 0.5, 40)], indexing="ij"), axis=-1)
    waves = np.sin(grid @ rng.normal(0, 9.0, (2, 6)) + rng.uniform(0, 6, 6)).mean(axis=-1)
    return sheet_triangles(middle + grid @ np.array([along, across])
                           + bump * waves[..., None] * _UP)


def proposed(scan: Scan) -> Iterator[tuple[Part, float]]:
    """What may be a part of a scan, and its overlap with a thing of that kind. It is sought without
    what is removed or found before, ground also where only a plant is."""
    on_ground = scan.without("sheet")
    bare = on_ground.without("ground")
    placed = surroundings.upright(bare.points, _UP)
    held = [Part(kind, np.flatnonzero(bare.thing == number), 0.0)
            for number, kind in enumerate(bare.kinds) if kind in ("pot", "stake")]
    for one, part in (
            *((one, surroundings.find_ground(one.points, _UP)) for one in (on_ground, bare)),
            *((bare, part) for part in surroundings.bodies(placed)),
            *((bare, part) for part in surroundings.wires(bare.points, placed, held))):
        if part is not None:
            yield part, one.overlap(part)


def gathered(source: str, seeds: Sequence[int]) -> dict[str, np.ndarray]:
    """Of each kind a table: what speaks against parts of scenes, their overlap with a thing of that
    kind, and the scene's seed."""
    parts = [(MODEL.get(part.kind, part.kind), np.r_[part.against, overlap, seed])
             for seed in seeds for part, overlap in proposed(scene(seed, source))]
    return {kind: np.array([row for each, row in parts if each == kind]) for kind in _KINDS}


def trained(tables: Sequence[np.ndarray]) -> np.ndarray:
    """Constant and slopes, none above 0, of the log odds that a part is a thing.

    What is half of a thing teaches nothing. A scan has many parts that could be one: the odds of
    the likeliest of each scene are fitted to what it is, so that they say how likely it is that
    such a thing is there at all.
    """
    rows = np.vstack(tables)
    sure = rows[(rows[:, -2] > _ALL) | (rows[:, -2] < _NONE)]
    odds = fitted(sure[:, :-2], sure[:, -2] > _ALL, (-1,) * (rows.shape[1] - 2))
    best = np.vstack([likeliest(table, odds) for table in tables])
    first, slope = fitted(best[:, :1], best[:, 1] > _HALF, (1,))
    return np.append(first, 0 * odds[1:]) + slope * odds


def likeliest(table: np.ndarray, odds: np.ndarray) -> np.ndarray:
    """Log odds and overlap of the likeliest part of each scene, shape [scenes, 2]."""
    told = np.column_stack([odds[0] + table[:, :-2] @ odds[1:], table[:, -2]])
    seeds = [np.flatnonzero(table[:, -1] == seed) for seed in np.unique(table[:, -1])]
    return told[[own[np.argmax(told[own, 0])] for own in seeds]]


def main() -> None:
    """Make scenes, train, write the weights, and measure them on the sources left out."""
    tables = {source: gathered(source, _SEEDS) for source in (*SOURCES, OWN)}
    made = {}
    for kind in _KINDS:
        inside, outside = ([table[kind] for source, table in tables.items() if (
            source in LEFT_OUT) is is_out and len(table[kind])] for is_out in (False, True))
        made[kind] = trained(inside)
        told = np.vstack([likeliest(table, made[kind]) for table in outside])
        print(kind, "said to be none, perhaps, one; in scenes without and with it", np.histogram2d(
            told[:, 1] > _HALF, expit(told[:, 0]), (2, [0, 1 - OPEN, OPEN, 1]))[0].tolist())
    np.savez_compressed(surroundings.ODDS, **made)


if __name__ == "__main__":
    main()
