"""Frames as files: PC2 byte for byte, and its refusals."""

import struct

import numpy as np
import pytest

from limber.core.errors import InputError
from limber.geometry.tets.tree_sweep import straight_beam
from limber.mechanics import BranchModel
from limber.mechanics.strain import strain_state
from limber.results.motion_files import read_pc2, surface_fields, surface_nodes, write_pc2


def test_pc2_layout(tmp_path):
    """The header is what Blender reads; positions are little-endian 32-bit floats by frame."""
    positions = np.arange(2 * 3 * 3, dtype=float).reshape(2, 3, 3)
    write_pc2(tmp_path / "a.pc2", positions, 1.0, 1.0)
    data = (tmp_path / "a.pc2").read_bytes()
    assert struct.unpack("<12siiffi", data[:32]) == (b"POINTCACHE2\0", 1, 3, 1.0, 1.0, 2)
    assert np.array_equal(np.frombuffer(data[32:], "<f4"), np.arange(18))
    assert np.array_equal(read_pc2(tmp_path / "a.pc2")[0], positions)


@pytest.mark.parametrize("positions", [
    np.zeros((0, 3, 3)), np.zeros((3, 3)), np.full((1, 1, 3), np.nan), np.full((1, 1, 3), np.inf)])
def test_what_cannot_be_played_is_refused(tmp_path, positions):
    """No frames, another shape or positions that are not finite are refused before writing."""
    with pytest.raises(InputError):
        write_pc2(tmp_path / "a.pc2", positions, 0.0, 1.0)
    assert not (tmp_path / "a.pc2").exists()


def test_cut_off_file_is_refused(tmp_path):
    """A file that is shorter than its header says is an error, not fewer frames."""
    write_pc2(tmp_path / "a.pc2", np.zeros((2, 4, 3)), 0.0, 1.0)
    data = (tmp_path / "a.pc2").read_bytes()
    for wrong in (data[:-4], data[:10], b"x" * 40):
        (tmp_path / "a.pc2").write_bytes(wrong)
        with pytest.raises(InputError, match=r"a\.pc2"):
            read_pc2(tmp_path / "a.pc2")


def test_surface_fields_of_a_known_deformation():
    """Uniform stretch: strain, stress, energy density and det F are the formulas', everywhere."""
    mesh = straight_beam(0.2, 0.01, slice_count=4)
    model = BranchModel(mesh, young=1e7, poisson=0.0, density=900.0, gravity=None)
    states = []
    for stretch in (1.0, 1.02):
        displacement = np.zeros_like(mesh.nodes)
        displacement[:, 2] = (stretch - 1) * mesh.nodes[:, 2]
        states.append(strain_state(model, displacement))
    fields = surface_fields(mesh, states)
    strain = (1.02**2 - 1) / 2
    expected = {"principal_strain": strain, "strain_energy_density_j_m3": 0.5 * 1e7 * strain**2,
                "principal_stress_pa": 1e7 * strain * 1.02, "det_f": 1.02}
    assert set(fields) == set(expected)
    for name, value in expected.items():
        assert fields[name].shape == (2, len(surface_nodes(mesh)))
        np.testing.assert_allclose(fields[name][1], value, rtol=1e-4)
        np.testing.assert_allclose(fields[name][0], 1.0 if name == "det_f" else 0.0, atol=1e-5)
