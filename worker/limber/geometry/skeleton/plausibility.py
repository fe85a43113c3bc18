"""Check whether a cloud and its skeleton can be a plant: errors and warnings."""

from collections.abc import Callable
from typing import Any

import numpy as np

from limber.core.errors import InputError, Option, Place, Text
from limber.geometry.cloud.surroundings import find_sheet
from limber.geometry.settings import OPEN
from limber.geometry.skeleton.contraction import ContractionStatus
from limber.geometry.skeleton.curve_graph import CurveGraph
from limber.geometry.skeleton.qsm_tables import cylinders
from limber.geometry.skeleton.skeleton import Skeleton

_STOUT = 0.13  # median distance from the axes over the cloud's size; leafy seedlings 0.1, balls 0.2
_ROUND = 0.3  # fraction of the radius by which points of a round branch may scatter
_MOST_OFF = 0.5  # fraction of points off all axes above which these do not describe the scan
_NAMED = 3  # gaps and loops named one by one
_FIX = Text("Crop the scan to one branch (", Option("crop"), "), or provide a "
            "skeleton (", Option("skeleton"), ").")


def check_one_plant(graph: CurveGraph, count: int, diagonal: float, plants: str) -> None:
    """InputError for a ball, and for two plants unless ``plants`` states which one to use
    (``refuse``, ``largest``, ``joined``)."""
    if len(graph.nodes) < 4:
        raise InputError(f"The cloud contracts to {len(graph.nodes)} points.",
                         "The cloud does not have the shape of a branch: it has no axis.", _FIX)
    length = float(np.linalg.norm(
        graph.nodes[graph.edges[:, 0]] - graph.nodes[graph.edges[:, 1]], axis=1).sum())
    thick = float(np.median(graph.thickness))
    if length < 4 * thick:
        raise InputError(
            f"The axes have a length of {length:.3g} m and a radius of {thick:.3g} m.",
            "The cloud does not have the shape of a branch: it is too thick.", _FIX)
    if plants == "largest":
        return
    for plant in graph.plants:
        raise InputError(
            Text(f"The scan contains two plants, {plant['distance']:.3g} m apart at ",
                 Place(plant["at"]), " in the scan's coordinates. "
                 f"{100 * plant['points'] / count:.0f} % of the points have a base of their own."),
            "A branch belongs to one plant, and the scan does not show which one is meant.",
            _FIX, " Or use the larger plant (", Option("plants", "largest"), "), or join them (",
            Option("plants", "joined"), ").")
    for piece in graph.split_off:
        share = piece["points"] / count
        if share > 0.2 and piece["distance"] > 0.25 * diagonal:
            raise InputError(Text(
                f"The scan contains two distant clusters. {100 * share:.0f} % of the points lie "
                f"{piece['distance']:.3g} m from the rest, at ", Place(piece["at"]), " in the "
                "scan's coordinates."), "A branch must be connected.", _FIX, " Or use the larger "
                "cluster (", Option("plants", "largest"), ").")


def check_slender(skeleton: Skeleton, points: np.ndarray, segment: np.ndarray,
                  residual: np.ndarray) -> None:
    """Refuse a cloud far from its axes (a ball). Leaves give a warning only."""
    away = float(np.median(np.abs(residual + skeleton.radius[segment])))
    if away > _STOUT * float(np.linalg.norm(np.ptp(points, axis=0))):
        raise InputError(
            f"The points have a median distance of {away:.3g} m from their axes.",
            "The cloud does not have the shape of a branch.", _FIX)


def check_no_sheet(points: np.ndarray) -> None:
    """Refuse a cloud that is one wall, whose points would be removed, and nothing else."""
    sheet = find_sheet(points, 0.9 * len(points))
    if sheet is not None and sheet.probability >= OPEN:
        raise InputError("Over 90 % of the points lie on one wide flat sheet.",
                         "The cloud does not have the shape of a branch.", _FIX)


def warnings(result: Any) -> list[str]:
    """Return the warnings about a skeleton, with places in its frame."""
    texts = []
    if result.contraction.status is ContractionStatus.given:
        far = float(np.mean(np.abs(result.residual) > 3 * result.skeleton.radius[
            result.node_of_point]))
        if far > 0.5:
            texts.append(f"{100 * far:.0f} % of the points are far from the given skeleton. Does "
                         "it have the coordinates and the unit of the cloud?")
        return texts
    texts += _joining_texts(result) + _doubt_texts(result)
    misfit = unexplained_share(result)
    if misfit > 0.15:
        off = _unexplained(result)
        most = int(np.argmax(np.bincount(result.node_of_point[off])))
        texts.append(Text(_off_text(result, off), ", most of them around ",
                          Place(result.skeleton.nodes[most]),
                          ". The radii there are unreliable."))
    elif not shows_round(result):
        texts.append(f"The points scatter by {1000 * result.noise:.2g} mm, more than {_ROUND:.0%} "
                     "of the radius of their axes. Leaves among them would therefore not be "
                     "detected.")
    return texts


def _joining_texts(result: Any) -> list[str]:
    """Warnings about bridges, discarded pieces and loops."""
    texts: list[str] = []
    longest = sorted(result.bridges, key=lambda bridge: -bridge["length"])
    for bridge in longest[:_NAMED]:
        texts.append(Text(f"A gap of {1000 * bridge['length']:.0f} mm was bridged at ",
                          Place(bridge["to"]), "."))
    if len(longest) > _NAMED:
        texts.append(f"{len(longest) - _NAMED} shorter gaps were bridged "
                     f"(up to {1000 * longest[_NAMED]['length']:.0f} mm).")
    lost = sum(piece["points"] for piece in result.split_off)
    if lost:
        share = 100 * lost / len(result.contraction.points)
        largest = max(result.split_off, key=lambda piece: piece["points"])
        texts.append(Text(
            f"{len(result.split_off)} pieces ({share:.1f} % of the points) were discarded, "
            "because they are too far from the rest for their size. The largest is "
            f"{1000 * largest['distance']:.0f} mm away, at ", Place(largest["at"]), "."))
    for loop in sorted(result.loops)[::-1][:_NAMED]:
        texts.append(f"A closed loop of {1000 * loop:.0f} mm was opened where branches touch.")
    if len(result.loops) > _NAMED:
        texts.append(f"{len(result.loops) - _NAMED} shorter closed loops were also opened.")
    return texts


def _doubt_texts(result: Any) -> list[str]:
    """Warnings about dropped twigs, and about the root."""
    texts: list[str] = []
    if result.unlikely:
        longest = max(twig["length"] for twig in result.unlikely)
        texts.append(f"{len(result.unlikely)} twigs (up to {1000 * longest:.0f} mm) were "
                     "discarded, because they probably do not exist.")
    if result.second_base is not None:
        texts.append(Text("The plant has a second base at ", Place(result.second_base),
                          ". If two plants touch, crop the scan to one of them (",
                          Option("crop"), ")."))
    if len(result.root_ends) > 1:
        ends = [Text("the end at ", Place(end["at"]), " with a probability of "
                     f"{end['probability']:.2f}") for end in result.root_ends]
        texts.append(Text("Which end is the root is uncertain: ", Text.joined(", ", ends),
                          ". The first was taken. If it is another, state it with ",
                          Option("root"), "."))
    return texts


def surface_text(share: float) -> str:
    """Warning that the volume is unresolved."""
    return (f"The points show a surface for {100 * share:.0f} % of the volume only. Elsewhere they "
            "scatter as points all through the sections would, and radii there are those that wood "
            "of this length usually has. The volume is unresolved and not stated, and masses and "
            "stiffnesses that follow from it are guesses.")


def root_question(ends: list[dict]) -> InputError:
    """Return the error that asks which of the likeliest ends, in the scan's coordinates, is the
    root."""
    ways = [Text(Option("root", tuple(round(float(v), 3) for v in end["at"])),
                 f" (probability {end['probability']:.2f})") for end in ends]
    return InputError(
        f"The scan does not show which of {len(ends)} ends is the root.",
        "Their thickness and height, the taper of the axes and the directions of side branches do "
        "not decide between them. The fixed end and the radii depend on it.",
        "State a place near the root, in the scan's coordinates: ", Text.joined(", ", ways),
        ". Or take the likeliest end (", Option("root", "auto"), ").").at(ends[0]["at"])


def shows_round(result: Any) -> bool:
    """Whether points lie close enough to the surface around their axes to show round sections. A
    leaf's do not: it becomes a rod that they fill."""
    radius = result.skeleton.radius[result.node_of_point]
    return bool(result.noise <= _ROUND * float(np.median(radius)))


def unexplained_share(result: Any) -> float:
    """Fraction of points that belong to no round axis: leaves, flying pixels, a second plant."""
    return float(np.mean(_unexplained(result)))


def off_axes(result: Any) -> np.ndarray:
    """Which points count against a scan because they belong to no round axis, shape [m]."""
    if result.leafy:
        return _unexplained(result)
    # A depth camera's scatter is noise, not leaves: only points beyond its reach count.
    radius = result.skeleton.radius[result.node_of_point]
    return result.residual > np.maximum(radius, 3 * result.noise)


def check_explained(result: Any, limit: float, points: np.ndarray,
                    not_wood: Callable[[np.ndarray], bool]) -> None:
    """InputError if over ``limit`` of the points belong to no round axis. Noise alone puts up to
    half of them off thin branches: they are accepted, unless ``not_wood``, of a mask of the points,
    says that they are leaves or supports."""
    off = off_axes(result)
    share = float(np.mean(off))
    if share <= limit or (share <= _MOST_OFF and not not_wood(off)):
        return
    # The point nearest to the middle of these: the middle itself may be empty.
    stray = points[off]
    place = stray[np.argmin(np.linalg.norm(stray - np.median(stray, axis=0), axis=1))]
    raise InputError(Text(_off_text(result, off), f" (allowed: {100 * limit:.0f} %), among them "
                          "those at ", Place(place), " in the scan's coordinates."),
                     "What is not round would become rods, and the radii there are unreliable.",
                     "Remove these points from the scan (", Option("crop"), ", or in another "
                     "program), remove leaves (", Option("leaves", "cut"), "), or accept the axes "
                     "as they are (", Option("unexplained", 1), ").")


def _unexplained(result: Any) -> np.ndarray:
    # Leaves make the noise look large. A point a whole radius off is on no axis, whatever the
    # noise.
    radius = result.skeleton.radius[result.node_of_point]
    return np.abs(result.residual) > np.clip(3 * result.noise, 0.4 * radius, radius)


def _off_text(result: Any, off: np.ndarray) -> str:
    """How many points, of mask ``off`` [m], lie off the round axes, and how far."""
    least = 1000 * float(np.abs(result.residual[off]).min())
    return (f"{off.sum()} points ({100 * np.mean(off):.0f} %) lie off the round axes' surfaces by "
            f"more than {least:.2g} mm")


# How much of a skeleton's volume points show by lying on a surface, and not all through it.

RESOLVED = 0.5
"""Fraction of the volume that points must show, for the whole to be stated."""
_STRETCH = 10.0  # length, in median radii of a run, that is judged by itself
_FITTED = 5  # numbers of a cylinder that were fitted to a stretch's points
_SURE = np.log(19.0)  # odds of 95 %
_FAR = 0.05  # fraction of points, the farthest, that do not count: leaves, other branches


def surface_share(skeleton: Skeleton, node_of_point: np.ndarray, residual: np.ndarray) -> float:
    """Fraction of the volume in stretches whose points show a surface: their distances from the
    axis are 19 times as likely with a mean and a scatter as all through the section. One depth
    camera shows it as well as a scan from all around."""
    stretch = _stretches(skeleton)
    of_point = stretch[node_of_point]
    away = np.maximum(1 + residual / skeleton.radius[node_of_point], 1e-3)
    order = np.lexsort((away, of_point))
    ends = np.cumsum(np.bincount(of_point, minlength=stretch.max() + 1))
    shown = np.array([_log_odds(own[:int(np.ceil((1 - _FAR) * len(own)))]) > _SURE
                      for own in np.split(away[order], ends[:-1])])
    volume = cylinders(skeleton)[1]
    return float(volume[shown[stretch[1:]]].sum() / max(volume.sum(), 1e-300))


def without_volumes(share: float) -> dict[str, Any]:
    """Return the numbers of a stage's result of which a scan with this share states none."""
    return {"surface_share": share} | ({} if share >= RESOLVED else dict.fromkeys((
        "surface_volume_m3", "mesh_volume_m3", "expected_volume_m3", "volume_interval_m3")))


def _stretches(skeleton: Skeleton) -> np.ndarray:
    """Number of each node's stretch, shape [n]."""
    label = np.zeros(skeleton.node_count, np.int64)
    for run, nodes in enumerate(skeleton.own_runs()):
        along = np.cumsum(skeleton.steps[nodes])
        label[nodes] = skeleton.node_count * run + (
            along - along[0]) // (_STRETCH * float(np.median(skeleton.radius[nodes])))
    return np.unique(label, return_inverse=True)[1]


def _log_odds(away: np.ndarray) -> float:
    """Logarithm of the odds of a surface, from distances over radii, shape [m]."""
    count = len(away)
    if count <= _FITTED:
        return -np.inf
    # What was fitted to the points makes their scatter look small.
    scatter = np.sqrt(max(float(away.var()), 1e-4) * count / (count - _FITTED))
    square = float(np.mean(away**2)) / 2
    return float(count * (np.log(square / scatter) + 0.5 - 0.5 * np.log(2 * np.pi)) - np.sum(
        np.log(away)))
