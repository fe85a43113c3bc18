"""Surfaces of other programs: registry of their formats, and checks before filling.
"""

from pathlib import Path

import numpy as np

from limber.core.errors import InputError
from limber.geometry.io.formats import Format, Registry
from limber.geometry.surface.surface import Surface, crossings, edges_of, pieces, position_text

SURFACES = Registry("surface", "limber.surfaces", [
    Format("triangles", (".stl", ".ply", ".obj", ".off", ".glb", ".gltf"), Surface.read)])
"""Readers take ``scale``, the metres per unit."""
_ROUNDED = 1e-5
"""Fraction of the extent: rounding to five or six digits separates vertices by up to this."""


def usable_surface(surface: Surface, path: Path) -> tuple[Surface, list[str]]:
    """Return a surface [m] that encloses a solid, and warnings about changes. InputError says where
    it has holes, edges of over two faces, turned faces, cavities, crossings or several bodies."""
    warnings = []
    corner = surface.faces
    flat = ((corner[:, 0] == corner[:, 1]) | (corner[:, 1] == corner[:, 2])
            | (corner[:, 2] == corner[:, 0]))
    if flat.any():
        surface = Surface(surface.vertices, corner[~flat])
        warnings.append(f"{int(flat.sum())} faces without area were discarded.")
    surface, welded = _welded(surface)
    warnings += welded
    _check_edges(surface, path)
    surface, turned = _one_body(surface, path)
    warnings += turned
    found = crossings(surface)
    if len(found):
        raise InputError(f"{path} intersects itself at {len(found)} points, one of them at "
                         f"{position_text(found[0])}.",
                         "The surface of a solid must not intersect itself.",
                         "Unite its parts (in Blender: a Boolean modifier with Self), then mesh "
                         "the surface again.")
    return surface, warnings


def _welded(surface: Surface) -> tuple[Surface, list[str]]:
    """Merge vertices that rounding has moved apart, if that closes the surface."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    if not _open_edges(surface.faces):
        return surface, []
    reach = _ROUNDED * float(np.linalg.norm(np.ptp(surface.vertices, axis=0)))
    pairs = cKDTree(surface.vertices).query_pairs(reach, output_type="ndarray")
    if not len(pairs):
        return surface, []
    count = len(surface.vertices)
    links = coo_array((np.ones(len(pairs)), pairs.T), (count, count))
    _, label = connected_components(links, directed=False)
    _, first = np.unique(label, return_index=True)
    faces = label[surface.faces]
    faces = faces[(np.diff(faces[:, [0, 1, 2, 0]], axis=1) != 0).all(axis=1)]
    if _open_edges(faces):
        return surface, []
    return Surface(surface.vertices[first], faces), [
        f"{count - len(first)} vertices that lie less than {1e3 * reach:.2g} mm from another were "
        "united with it."]


def _open_edges(faces: np.ndarray) -> int:
    """Edges of a single face."""
    return int((edges_of(faces)[1] == 1).sum())


def _check_edges(surface: Surface, path: Path) -> None:
    edges, counts, balance = edges_of(surface.faces)
    middle = surface.vertices[edges].mean(axis=1)
    if (counts == 1).any():
        raise InputError(f"{path} has holes: {int((counts == 1).sum())} open edges, one of them at "
                         f"{position_text(middle[counts == 1][0])}.", "The surface must be closed.",
                         "Close the holes (in Blender: select non-manifold, fill), then mesh the "
                         "surface again.")
    if (counts > 2).any():
        raise InputError(f"{path} has {int((counts > 2).sum())} edges with more than two faces, "
                         f"one of them at {position_text(middle[counts > 2][0])}.",
                         "Each edge of a solid has two faces.",
                         "Delete duplicate and inner faces (in Blender: Merge by Distance, then "
                         "select non-manifold), then mesh the surface again.")
    if balance.any():
        raise InputError(f"{path} has faces that point inwards and faces that point outwards, for "
                         f"example at {position_text(middle[balance != 0][0])}.",
                         "All faces must have the same orientation.",
                         "Recalculate the normals (in Blender: Shift N).")


def _one_body(surface: Surface, path: Path) -> tuple[Surface, list[str]]:
    """Turn the surface outwards; refuse several bodies, or one with cavities."""
    label = pieces(surface)[surface.faces[:, 0]]
    parts = [Surface(surface.vertices, surface.faces[label == k]) for k in range(label.max() + 1)]
    volume = np.array([part.volume for part in parts])
    size = float(np.linalg.norm(np.ptp(surface.vertices, axis=0)))
    if np.abs(volume).max() <= 1e-9 * size**3:
        raise InputError(f"{path} encloses no volume.", "A solid was expected, not a sheet.",
                         "Give it thickness (in Blender: a Solidify modifier).")
    if len(parts) > 1:
        largest = int(np.argmax(np.abs(volume)))
        others = [part.faces[0, 0] for k, part in enumerate(parts) if k != largest]
        corner = surface.vertices[others]
        inner = corner[np.abs(parts[largest].winding(corner)) > 0.5]
        if len(inner):
            raise InputError(f"{path} has {len(inner)} closed surfaces inside its largest one, one "
                             f"of them at {position_text(inner[0])}.",
                             "A branch is a solid without cavities.",
                             "Delete the inner surfaces (in Blender: separate by loose parts), "
                             "then mesh the surface again.")
        share = np.sort(np.abs(volume))[::-1] / np.abs(volume).sum()
        raise InputError(
            f"{path} has {len(parts)} separate bodies, with "
            + ", ".join(f"{100 * s:.2g} %" for s in share[:4]) + " of the volume.",
            "One connected body was expected.",
            "Keep one body (in Blender: separate by loose parts), or unite them with a Boolean "
            "modifier, then mesh the surface again.")
    if volume[0] < 0:
        return Surface(surface.vertices, surface.faces[:, ::-1]), [
            "All faces pointed inwards. They were flipped."]
    return surface, []
