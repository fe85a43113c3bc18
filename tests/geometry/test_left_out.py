"""Wood that the mesh leaves out is named and weighed; branches that touch are told."""

import numpy as np
import pytest
from tests.subjects.grown import grown

from limber.core.errors import MeshingError
from limber.core.progress import SILENT
from limber.geometry.pruned_twigs import (
    report_pruned_twigs,
    touching_runs,
    touching_texts,
    twig_mass,
)
from limber.geometry.settings import ReconstructSettings
from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.skeleton.sweep import frames, tangents
from limber.geometry.surface.tubes import branch_surface


def _tree(aside: float) -> Skeleton:
    """A stem, and two twigs of it whose ends come as near as ``aside`` [m]."""
    return grown((-1, (0, 0, 0), (0, 0, 0.5), 51, 0.008),
                 (10, (0, 0, 0.1), (0.15, 0, 0.1), 21, 0.004),
                 (20, (0, 0, 0.2), (0.15, 0, 0.1 + aside), 21, 0.004))


def test_a_twig_is_a_rod() -> None:
    """Mass, centre and inertia of a straight twig are those of a slender rod."""
    skeleton = _tree(0.05)
    straight = next(run for run, members in enumerate(skeleton.runs())
                    if run and np.ptp(skeleton.nodes[members][:, 2]) < 1e-9)
    rod = twig_mass(skeleton, straight, 900.0)
    mass = 900 * np.pi * 0.004**2 * 0.15
    assert rod["mass_kg"] == pytest.approx(mass) and rod["length_m"] == pytest.approx(0.15)
    np.testing.assert_allclose(rod["centre_m"], [0.075, 0, 0.1], atol=1e-9)
    np.testing.assert_allclose(rod["attached_m"], [0, 0, 0.1], atol=1e-9)
    np.testing.assert_allclose(
        rod["inertia_kg_m2"], np.diag([0, 1, 1]) * mass * 0.15**2 / 12, atol=1e-12)


def test_much_left_out_is_asked_for() -> None:
    """Over 3 % of the mass the stage stops and names the branch, unless it is accepted."""
    masses = [twig_mass(_tree(0.05), 1, 900.0)]
    with pytest.raises(MeshingError, match=r"branch 1 \(1\d\d mm.*--leave-out"):
        report_pruned_twigs(masses, 0.05, ReconstructSettings(), SILENT)
    said: list[str] = []
    report_pruned_twigs(masses, 0.05, ReconstructSettings(leave_out=True), SILENT.keeping(said))
    report_pruned_twigs(masses, 5.0, ReconstructSettings(), SILENT.keeping(said))
    assert len(said) == 2 and all("branch 1" in text for text in said)


def test_touching_branches_are_named() -> None:
    """Two twigs that meet make a handle of the surface, told with its place; apart, none."""
    apart, touching = _tree(0.05), _tree(0.004)
    assert branch_surface(apart).handle_count == 0 and not touching_runs(apart)
    assert branch_surface(touching).handle_count == 1
    found = touching_runs(touching)
    assert found[0]["branches"] == [1, 2] and found[0]["at_m"][0] == pytest.approx(0.15, abs=0.04)
    assert "1 handle:" in touching_texts(1, found)[0]


def test_two_nodes_at_one_place_make_no_nan() -> None:
    """Frames go on over a repeated node, near the origin and far from it."""
    line = np.array([[0, 0, 0], [0, 0, 0.1], [0, 0, 0.1], [0, 0.02, 0.2], [0, 0.05, 0.3]])
    for shift in (0.0, 4e5):
        normals, binormals = frames(line + shift, tangents(line + shift))
        assert np.isfinite(normals).all() and np.isfinite(binormals).all()
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-9)
