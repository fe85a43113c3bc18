"""Compiles the loops over points and surfaces once, so that no user waits for a compiler."""

import numpy as np

from limber.core.progress import SILENT, Progress
from limber.geometry.cloud.leaves import leaf_log_odds, surroundings
from limber.geometry.skeleton.contraction import contract
from limber.geometry.skeleton.joining import join_pieces
from limber.geometry.skeleton.likeliest_tree import State, grown, pruned
from limber.geometry.skeleton.radii.axis_fit import fit_axes
from limber.geometry.skeleton.radii.fit_kernels import reach_on_circle
from limber.geometry.skeleton.radii.stations import station_sums
from limber.geometry.skeleton.radii.visible_sides import flatness
from limber.geometry.skeleton.repair import PointSpacing
from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.skeleton.tree_likelihood import PointLikelihood
from limber.geometry.surface.surface import distance_to_surface
from limber.geometry.surface.tubes import branch_surface


def warm_up(progress: Progress = SILENT) -> None:
    """Fit and surface one fork; takes about 10 s if nothing is compiled yet."""
    skeleton = Skeleton.from_edges(
        np.array([[0, 0, 0], [0, 0, 0.1], [0, 0, 0.2], [0.05, 0, 0.15]]),
        np.array([-1, 0, 1, 1]), np.array([0.01, 0.01, 0.01, 0.005]))
    progress(0.1, "compiling the surface's loops")
    surface = branch_surface(skeleton)
    distance_to_surface(skeleton.nodes, surface)
    contract(surface.vertices)
    fit_axes(skeleton, surface.vertices, rounds=1, settled=True)
    way, size = np.eye(3), np.ones(3)
    station_sums(way, size, way, way, way, size, size[:2], 0.0, 1.0)  # by merged scans alone
    flatness(way, way, way)  # by noisy scans alone
    grown(pruned(State.of(skeleton, PointLikelihood.of(surface.vertices))),
          PointSpacing.of(surface.vertices))  # used by thin scans alone
    line = np.array([[0, 0, 0.01 * k] for k in (*range(4), *range(6, 10))])
    join_pieces(line, np.array([[0, 1], [1, 2], [2, 3], [4, 5], [5, 6], [6, 7]]), np.full(8, 0.01),
                np.full(8, 20), np.full(8, 0.01), gap=0.03, bridge_limit=0.1,
                up=np.array([0.0, 0.0, 1.0]), join_plants=False)
    reach_on_circle(np.zeros(1), np.ones(1), np.ones(1), 1.0, 0.5)  # used by one-sided scans alone
    leaf_log_odds(surroundings(skeleton.nodes, 0.1))
    progress(1.0, "compiling the surface's loops")
