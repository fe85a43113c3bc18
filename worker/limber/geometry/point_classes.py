"""The classes of a refused scan's points, as a coloured cloud to look at."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np

from limber.core.errors import InputError
from limber.geometry.cloud.cloud import Cloud
from limber.geometry.cloud.leaves import Leaf
from limber.geometry.cloud.preparation import Prepared
from limber.geometry.cloud.supports import Support
from limber.geometry.leaf_removal import leaf_mask

COLOURS = {"wood": (139, 90, 43), "leaf": (60, 170, 60), "on no round axis": (220, 40, 40),
           "pot": (150, 150, 150), "stake": (60, 110, 230), "post": (30, 50, 140),
           "wire": (90, 200, 230), "another plant": (170, 90, 200)}
"""Red, green and blue of each class; its place is the value of the column ``class``."""

Show = Callable[[Cloud], None]
"""Receives the coloured cloud: metres, with the axes and the origin of the scan's file."""


@contextmanager
def shown_if_refused(show: Show | None, prepared: Prepared, leaves: list[Leaf],
                     supports: list[Support], off_axes: np.ndarray | None = None,
                     ) -> Iterator[None]:
    """Show the points by class if what is done meanwhile refuses the scan.

    Args:
        show: Receives the cloud; None: nobody looks.
        prepared: The whole scan.
        leaves: Its leaves.
        supports: Its pots, stakes, posts and wires.
        off_axes: Which of the other points are on no round axis, shape [rest]; None: not known.
    """
    try:
        yield
    except InputError:
        if show is not None:
            show(classified(prepared, leaves, supports, off_axes))
        raise


def classified(prepared: Prepared, leaves: list[Leaf], supports: list[Support],
               off_axes: np.ndarray | None = None, apart: np.ndarray | None = None) -> Cloud:
    """Return the points with columns ``class`` and ``color``, see :func:`shown_if_refused`.

    ``apart``: which of the points belong to another plant, shape [n].
    """
    kind = leaf_mask(leaves, len(prepared.cloud)).astype(np.uint8)
    if off_axes is not None:
        kind[np.flatnonzero(kind == 0)[off_axes]] = 2
    for support in supports:
        kind[support.points] = list(COLOURS).index(support.kind)
    if apart is not None:
        kind[apart] = list(COLOURS).index("another plant")
    colour = np.array(list(COLOURS.values()), np.uint8)
    return Cloud(prepared.cloud.points + prepared.origin, {"color": colour[kind], "class": kind})
