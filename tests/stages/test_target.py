"""`limber target`: places on the branch, what is refused, and who follows them."""

import json

import numpy as np
import pytest

from limber.cli.main import call
from limber.core.errors import InputError
from limber.core.progress import Progress
from limber.core.settings import checked_settings
from limber.geometry.tets.tree_sweep import straight_beam
from limber.stages.shape.target import TargetSettings, set_target
from limber.store import Branch
from limber.store.loading import load_branch, load_targets


@pytest.fixture
def folder(tmp_path):
    folder = tmp_path / "beam.branch"
    with Branch.create(folder).stage("mesh") as stage:
        straight_beam(0.3, 0.006, 0.005, slice_count=10, young=1e9).write(stage.path("mesh.vtu"))
    return folder


def test_targets_are_set_replaced_and_removed(folder, capsys):
    """By the command: each is said to hang on the nearest place of the branch; files agree."""
    assert call(["target", str(folder), "flower", "--at", "0.012", "0", "0.2", "--mass", "0.01",
                 "--json"]) == 0
    said = json.loads(capsys.readouterr().out.strip().splitlines()[-1])
    assert said["target"] == "flower" and said["targets"] == ["flower"]
    # The beam is 5.3 mm thick there, with six sides.
    assert 0.0062 < said["distance_m"] < 0.0077
    np.testing.assert_allclose(said["branch_point_m"][2], 0.2, atol=2e-3)
    set_target(folder, "leaf", TargetSettings(at=(0.0, 0.0, 0.1)))
    set_target(folder, "flower", TargetSettings(at=(0.0, 0.0, 0.25), mass=0.02))
    targets = load_targets(Branch.open(folder))
    assert [(t.name, t.position, t.mass) for t in targets] == [
        ("flower", (0.0, 0.0, 0.25), 0.02), ("leaf", (0.0, 0.0, 0.1), 0.0)]
    loaded = load_branch(Branch.open(folder), gravity=True,
        progress=Progress(on_warning=pytest.fail))
    assert [m.mass for m in loaded.model.point_masses] == [0.02]
    result = set_target(folder, "flower", TargetSettings(remove=True))
    assert result["targets"] == ["leaf"]
    assert [t.name for t in load_targets(Branch.open(folder))] == ["leaf"]


def test_one_that_is_there_is_left_as_it_is(folder):
    """Unless it was moved, taken out or asked for again; so is one that is not there."""
    def finished(name="flower"):
        return Branch.open(folder).manifest.stages[f"target:{name}"]
    wish = TargetSettings(at=(0.0, 0.0, 0.2))
    first = set_target(folder, "flower", wish)
    before = finished()
    set_target(folder, "leaf", TargetSettings(at=(0.0, 0.0, 0.1)))
    again = set_target(folder, "flower", wish)
    assert finished() == before and again["targets"] == ["flower", "leaf"]
    assert again["position_m"] == list(first["position_m"])
    set_target(folder, "flower", wish, force=True)
    assert finished() != before
    set_target(folder, "flower", TargetSettings(remove=True))
    assert set_target(folder, "flower", TargetSettings(remove=True))["targets"] == ["leaf"]
    set_target(folder, "flower", wish)
    assert {one.name for one in load_targets(Branch.open(folder))} == {"flower", "leaf"}


@pytest.mark.parametrize(("name", "settings", "words"), [
    ("flower", {"at": (0.2, 0.0, 0.2)}, "away from the branch"),
    ("flower", {"at": (0.0, 0.0, 200.0)}, "unit"),
    ("flower", {"at": (float("nan"), 0.0, 0.1)}, "finite"),
    ("../flower", {"at": (0.0, 0.0, 0.1)}, "cannot name"),
    ("flower", {}, "--remove"),
    ("flower", {"at": (0.0, 0.0, 0.1), "remove": True}, "Both"),
    ("flower", {"remove": True}, "no target"),
])
def test_what_is_refused(folder, name, settings, words):
    """With its reason; targets from before stay."""
    set_target(folder, "leaf", TargetSettings(at=(0.0, 0.0, 0.1)))
    with pytest.raises(InputError) as caught:
        set_target(folder, name, checked_settings(TargetSettings, settings))
    assert words in str(caught.value)
    assert [t.name for t in load_targets(Branch.open(folder))] == ["leaf"]


def test_newer_file_is_not_misread(folder):
    """Targets of another format are not guessed at."""
    with Branch.open(folder).stage("target:x") as stage:
        stage.path("targets.json").write_text('{"format_version": 2, "targets": []}')
    with pytest.raises(InputError, match="format 2"):
        load_targets(Branch.open(folder))
