"""Learnt models are kept, shared, bounded, and mended where they are damaged."""

import errno
import os
import threading
import time

import numpy as np
import pytest

from limber.core.progress import Progress
from limber.geometry.tets.tree_sweep import straight_beam
from limber.mechanics import BranchModel, Grasp, young_weights
from limber.mechanics.added_masses import PointMass
from limber.reduced import model_cache as cache_module
from limber.reduced.model_cache import ReducedCache, learnt_model, model_key
from limber.reduced.reduced_model import ReducedSettings
from limber.reduced.training import TrainingSettings

SETTINGS = ReducedSettings(size=20, field_count=40, training=TrainingSettings(
    grasp_count=8, young_spread=1.0, vibration_every=0))


@pytest.fixture(scope="module")
def branch():
    """Model, grasp, weights and modulus of a small beam."""
    mesh = straight_beam(0.2, 0.004, slice_count=6, young=1e8, grasp_fraction=0.7)
    model = BranchModel(mesh, young=1e8, poisson=0.35, density=900.0)
    weights = young_weights(mesh, np.array([[0.0, 0.0, 0.1]]))
    return model, Grasp.from_mesh(mesh, "point"), weights, np.array([1e8])


@pytest.fixture(scope="module")
def learnt(branch):
    return learnt_model(*branch, SETTINGS, cache=None)


def test_a_second_one_does_not_learn_again(branch, tmp_path, monkeypatch):
    """What comes back is what was learnt, to the last bit."""
    first = learnt_model(*branch, SETTINGS, cache=ReducedCache(tmp_path))
    monkeypatch.setattr(cache_module, "build_reduced", None)
    second = learnt_model(*branch, SETTINGS, cache=ReducedCache(tmp_path))
    assert (first.was_known, second.was_known) == (False, True)
    pose = branch[1].rest_pose + [0.02, 0, 0, 0, 0, 0]
    assert (first.reduced.solve_static(pose).strain_energy
            == second.reduced.solve_static(pose).strain_energy)
    np.testing.assert_array_equal(first.snapshots.displacement, second.snapshots.displacement)
    assert sorted(path.suffix for path in tmp_path.iterdir()) == [".lock", ".npz"]


def test_all_that_a_model_depends_on_is_in_its_key(branch):
    """Shape, material, weight, what hangs, patch, how it is held and settings tell models apart."""
    model, grasp, weights, young = branch
    mesh = model.mesh
    others = [
        (model.with_parameters(gravity=(0, 0, 0)), grasp, weights, young, SETTINGS),
        (model.as_scanned(), grasp, weights, young, SETTINGS),
        (model.with_parameters(density=800.0), grasp, weights, young, SETTINGS),
        (model.with_parameters(poisson=0.3), grasp, weights, young, SETTINGS),
        (model.with_point_masses([PointMass((0, 0, 0.2), 0.01)]), grasp, weights, young, SETTINGS),
        (model.with_rest_nodes(1.001 * mesh.nodes), grasp, weights, young, SETTINGS),
        (model, Grasp.from_mesh(mesh, "rigid"), weights, young, SETTINGS),
        (model, Grasp.of_nodes(mesh, grasp.nodes[1:], "point"), weights, young, SETTINGS),
        (model, grasp, weights, 2 * young, SETTINGS),
        (model, grasp, 0.5 * weights, young, SETTINGS),
        (model, grasp, weights, young, ReducedSettings(size=21))]
    keys = {model_key(*other) for other in others}
    assert len(keys) == len(others)
    assert model_key(*branch, SETTINGS) not in keys
    assert model_key(*branch, SETTINGS) == model_key(*branch, SETTINGS)


@pytest.mark.parametrize("damage", ["cut", "middle", "empty", "foreign"])
def test_a_damaged_entry_is_dropped_and_said(learnt, tmp_path, damage):
    """Cut short, changed inside, empty or of another kind: removed with a word, never believed."""
    said = []
    cache = ReducedCache(tmp_path, progress=Progress(on_warning=said.append))
    path = cache.store("key", learnt.reduced, learnt.snapshots)
    whole = path.read_bytes()
    middle = len(whole) // 2
    path.write_bytes({"cut": whole[:-100], "empty": b"", "foreign": b"text" * 100,
                      "middle": whole[:middle] + bytes([whole[middle] ^ 255]) + whole[middle + 1:],
                      }[damage])
    assert cache.load("key") is None
    assert len(said) == 1 and "key.npz" in said[0]
    assert not path.exists()
    assert cache.load("key") is None and len(said) == 1


def test_a_folder_that_cannot_be_written_costs_time_only(branch, learnt, tmp_path, monkeypatch):
    """A file in its place, as for one that is read-only or full: trained, not kept, said once."""
    (tmp_path / "cache").write_text("")
    monkeypatch.setattr(cache_module, "build_reduced",
                        lambda *_args: (learnt.reduced, learnt.snapshots))
    told = []
    for folder in (tmp_path / "cache", tmp_path / "cache" / "below"):
        told.clear()
        cache = ReducedCache(folder, progress=Progress(None, told.append))
        for _ in range(2):
            found = learnt_model(*branch, SETTINGS, cache=cache)
            assert found.reduced is learnt.reduced and not found.was_known
        assert len(told) == 1 and "cannot be stored" in told[0]
    full = ReducedCache(tmp_path / "full", progress=Progress(None, told.append))
    monkeypatch.setattr(cache_module, "write_model", _disk_full)
    told.clear()
    assert not learnt_model(*branch, SETTINGS, cache=full).was_known
    assert len(told) == 1 and "No space left" in told[0]
    assert not list((tmp_path / "full").glob("*.part"))


def _disk_full(*_args):
    raise OSError(errno.ENOSPC, "No space left on device")


def test_the_least_used_go_where_room_is_short(learnt, tmp_path):
    """The folder stays within its limit; what was used last stays; left-overs are swept."""
    first = ReducedCache(tmp_path).store("first", learnt.reduced, learnt.snapshots)
    size = first.stat().st_size
    cache = ReducedCache(tmp_path, limit_bytes=int(2.5 * size))
    left_over = tmp_path / "old.123.part"
    left_over.write_bytes(b"x")
    os.utime(left_over, (1, 1))
    second = cache.store("second", learnt.reduced, learnt.snapshots)
    os.utime(first, (100, 100))
    os.utime(second, (50, 50))
    assert cache.load("second") is not None  # used now
    third = cache.store("third", learnt.reduced, learnt.snapshots)
    assert not first.exists() and second.exists() and third.exists()
    assert not left_over.exists()
    tiny = ReducedCache(tmp_path, limit_bytes=1)
    last = tiny.store("last", learnt.reduced, learnt.snapshots)
    assert [path.name for path in tmp_path.glob("*.npz")] == [last.name]


@pytest.mark.slow
def test_two_at_once_learn_once(branch, learnt, tmp_path, monkeypatch):
    """The second waits for the first instead of learning beside it."""
    count = []

    def slow(*_arguments):
        count.append(1)
        time.sleep(1.0)
        return learnt.reduced, learnt.snapshots

    monkeypatch.setattr(cache_module, "build_reduced", slow)
    found = []
    threads = [threading.Thread(target=lambda: found.append(
        learnt_model(*branch, SETTINGS, cache=ReducedCache(tmp_path)))) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(30)
    assert len(found) == 3 and len(count) == 1
