"""The shell on which a grasp moves by itself.

A branch yields easily across and hardly along. Under forces across, its grasp stays within a tenth
of a millimetre on a sphere about a pivot a fifth to a quarter of the way up (the pseudo-rigid body
of a cantilever: Howell, Compliant Mechanisms, 2001, 5.1; measured on four branches, 40 %
deflection). Inside it the branch is pushed together and bends; beyond it is drawn taut, and the
force grows a hundred times as fast. Gentle paths run along the shell. So samples follow it, and
some are drawn a little beyond: no path is best at the limit of what was sampled.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from limber.mechanics import StaticResult, solve_static
from limber.planning.field.grasp_model import GraspModel, refusal
from limber.progress import SILENT, Progress

_STEP = 1e-4  # [m] of the moves that measure the stiffness at rest
_RIM = 1.1  # times the force that linear bending needs for the largest deflection
_GOLDEN = np.pi * (3.0 - np.sqrt(5.0))
_WORST = 0.02  # share of the radius that the sphere may miss the states by, root mean square


@dataclass(frozen=True)
class Valley:
    """A sphere: ``pivot`` [m] of shape [3] and ``radius`` [m]."""

    pivot: np.ndarray
    radius: float


def walk_valley(grasp_model: GraspModel, count: int, *, deflection: float, seed: int = 0,
                progress: Progress = SILENT) -> tuple[Valley, list[StaticResult]]:
    """Return the shell, and states of the branch on it and a little beyond.

    Args:
        count: Directions to go; each gives two states, one under a force across and one drawn
            outward besides, as strongly as the branch is bent at the largest deflection.
        deflection: Largest distance from rest, as a share of the arc length.
        seed: Turns the directions.

    A branch that is no cantilever (its states lie on no sphere) gets the sphere about its base.
    """
    rest, reach = grasp_model.rest, grasp_model.reach
    stiffness, axes = _stiffness(grasp_model)
    force = float(np.sqrt(max(stiffness[0] * stiffness[1], 0.0))) * deflection * reach.arc_length
    outward = _unit(grasp_model.rest_position - reach.base)
    turn = float(np.random.default_rng([seed, 11]).uniform(0.0, 2.0 * np.pi))
    slack, taut = [rest], [_under(grasp_model, force * outward, rest)]
    for number in range(count):
        progress(number / count, "how the grasp moves by itself")
        angle = turn + _GOLDEN * number
        across = _RIM * force * np.sqrt((number + 0.5) / count) * (
            np.cos(angle) * axes[:, 0] + np.sin(angle) * axes[:, 1])
        if (found := _under(grasp_model, across, rest)) is None:
            continue
        slack.append(found)
        outward = _unit(grasp_model.pose(found.displacement)[:3] - reach.base)
        taut.append(_under(grasp_model, across + force * outward, found))
    places = np.array([grasp_model.pose(state.displacement)[:3] for state in slack])
    return _sphere(places, reach.base, grasp_model.rest_position), [
        *slack[1:], *(state for state in taut if state is not None)]


def _stiffness(grasp_model: GraspModel) -> tuple[np.ndarray, np.ndarray]:
    """Return stiffnesses of the grasp at rest [N/m], ascending, and their axes as columns."""
    moved = [grasp_model.follow((grasp_model.rest_position + _STEP * axis)[None],
                                grasp_model.rest.displacement)[0].require().reaction_force / _STEP
             for axis in np.eye(3)]
    whole = np.array(moved)
    return np.linalg.eigh(0.5 * (whole + whole.T))


def _under(grasp_model: GraspModel, force: np.ndarray, start: StaticResult) -> StaticResult | None:
    """Return the state under a force [3] on the grasp, held there; None if there is none."""
    loose = solve_static(grasp_model.model, grasp=grasp_model.grasp, grasp_force=force,
                         start=start.displacement)
    if refusal(loose):
        return None
    place = grasp_model.pose(loose.displacement)[:3]
    held = grasp_model.follow(place[None], loose.displacement)[0]
    return None if refusal(held) else held


def _sphere(places: np.ndarray, base: np.ndarray, rest: np.ndarray) -> Valley:
    arm = rest - base
    chord = float(np.linalg.norm(arm))

    def missed(unknown: np.ndarray) -> np.ndarray:
        return np.linalg.norm(places - unknown[:3], axis=1) - unknown[3]

    if len(places) >= 8:
        found = least_squares(missed, np.r_[base + 0.2 * arm, 0.8 * chord], x_scale=chord)
        pivot, radius = found.x[:3], float(found.x[3])
        close = np.sqrt(np.mean(found.fun**2)) < _WORST * radius
        if close and 0.2 * chord < radius < 3.0 * chord and (rest - pivot) @ arm > 0.0:
            return Valley(pivot, radius)
    return Valley(np.asarray(base, float), chord)


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)
