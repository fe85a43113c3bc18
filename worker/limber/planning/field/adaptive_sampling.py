"""Samples added where the field's error is largest, until the requested error is met."""

from dataclasses import replace

import numpy as np

from limber.core.processes import run_tasks
from limber.core.progress import SILENT, Progress
from limber.planning.field.disagreeing_neighbours import neighbours
from limber.planning.field.energy_field import EnergyField, refit
from limber.planning.field.grasp_model import GraspModel
from limber.planning.field.sampling import Sampled
from limber.planning.field.stored_states import Solved, samples_of, taken

_ROUND = 0.15  # fraction of the samples added in a round
_FEWEST = 8
_APART = 0.5  # fraction of the distance between two samples that no other new one may be within
_SHARE_PLACES = 20
"""Places of one task; must not depend on the number of processes."""


def refined(grasp_model: GraspModel, sampled: Sampled, field: EnergyField, asked: float, most: int,
            *, workers: int | None = None, progress: Progress = SILENT,
            ) -> tuple[Sampled, EnergyField]:
    """Return the field with samples added where its error is largest.

    Ends when its error on left-out samples (``energy_error``) is at most ``asked``, a fraction, or
    there are ``most`` samples, or no more can be added.
    """
    begun = len(field.samples.poses)
    while field.errors["energy_error"] > asked and len(field.samples.poses) < most:
        count = len(field.samples.poses)
        progress((count - begun) / max(most - begun, 1),
                 "adding poses where the field's error is large",
                 error=field.errors["energy_error"], samples=count)
        positions, sources = _where_off(field,
                                        min(max(_FEWEST, round(_ROUND * count)), most - count))
        if not len(positions):
            break
        solved = _solved(grasp_model, positions, [sampled.displacements[k] for k in sources],
                         workers)
        good = [one for one in solved if not one.trouble]
        bad = np.array([one.trouble is not None for one in solved])
        added = samples_of(good, positions[bad]) if good else replace(
            field.samples.take(np.empty(0, int)), rejected_poses=np.hstack(
                [positions[bad], np.zeros((int(bad.sum()), 3))]))
        field = refit(field, added)
        sampled = replace(sampled, samples=field.samples, displacements=[
            *sampled.displacements, *(one.displacement for one in good)])
    return sampled, field


def _where_off(field: EnergyField, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return places [n, 3] half-way between neighbours where the energy's error is largest, and the
    sample nearest to each, [n].
    """
    chart, positions = field.region.chart, field.samples.positions
    flat = chart.map(positions)
    edges = neighbours(flat)
    off = np.where(field.region.is_face(), 0.0, np.abs(field.missed[:, 0]))
    distance = np.linalg.norm(flat[edges[:, 0]] - flat[edges[:, 1]], axis=1)
    middles = chart.curved(flat[edges].mean(axis=1))
    chosen: list[int] = []
    for k in np.argsort(-off[edges].sum(axis=1) * distance, kind="stable"):
        if len(chosen) == count or not off[edges[k]].any():
            break
        if not field.region.contains(middles[k])[0]:
            continue
        gaps = np.linalg.norm(middles[chosen] - middles[k], axis=1)
        if not len(gaps) or gaps.min() > _APART * distance[k]:
            chosen.append(int(k))
    nearest = np.linalg.norm(middles[chosen][:, None] - positions[None], axis=2)
    return middles[chosen], nearest.argmin(axis=1) if chosen else np.empty(0, int)


def _solved(grasp_model: GraspModel, positions: np.ndarray, starts: list[np.ndarray],
            workers: int | None) -> list[Solved]:
    shares = np.array_split(np.arange(len(positions)), max(2, -(-len(positions) // _SHARE_PLACES)))
    found = run_tasks(_solve, [(grasp_model, positions[k], [starts[n] for n in k])
                              for k in shares if len(k)],
                      workers=workers, message="adding poses where the field's error is large")
    return [one for share in found for one in share]


def _solve(grasp_model: GraspModel, positions: np.ndarray, starts: list[np.ndarray],
           ) -> list[Solved]:
    return [taken(grasp_model, grasp_model.follow(position[None], start)[0], number)
            for number, (position, start) in enumerate(zip(positions, starts, strict=True))]
