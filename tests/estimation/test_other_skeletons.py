"""Another likely skeleton of the scan enters the intervals of an estimate."""

import json
import re

import numpy as np
import pytest

from limber.cli.main import call
from limber.geometry.io.skeletons import read_swc
from limber.geometry.skeleton.edits import DeleteBranch, SetRadius
from limber.stages.moduli import other_skeletons
from limber.store import Branch

QUICK = ("--progress", "none", "--quick", "--fractions",
         "0.2,0.4,0.6,0.8", "--json", "--force")


def estimated(folder, capsys):
    assert call(["estimate", str(folder), *QUICK]) == 0
    capsys.readouterr()
    return json.loads((folder / "estimate.json").read_text())


def thicker(folder):
    """The same branch, of one radius from base to tip that is larger than all of its own."""
    skeleton = read_swc(folder / "skeleton.swc")
    path = skeleton.main_path()
    ends = [tuple(map(float, skeleton.nodes[node])) for node in path[[0, -1]]]
    return skeleton, SetRadius(at=ends[0], to=ends[1], radius=1.05 * float(skeleton.radius.max()))


@pytest.mark.slow
def test_the_moduli_of_another_skeleton_widen_the_intervals(branch_folder, capsys, monkeypatch):
    alone = estimated(branch_folder, capsys)
    assert alone["young_deviation"]["graph"] is None
    skeleton, edit = thicker(branch_folder)
    monkeypatch.setattr(other_skeletons, "_graphs",
                        lambda _: [other_skeletons._Graph(2, 0.5, [edit])])
    both = estimated(branch_folder, capsys)
    # A thicker branch needs a lower modulus: by the fourth power of the radius.
    control = np.interp(both["fractions"], np.linspace(0, 1, len(skeleton.main_path())),
                        skeleton.radius[skeleton.main_path()])
    told = [text for text in both["warnings"] if "alternative 2" in text]
    assert len(told) == 1 and "0.5 times" in told[0]
    likely, values = re.search(r"it is (\S+) times as likely, and gives (.*) MPa", told[0]).groups()
    change = np.log(1e-6 * np.array(alone["young_pa"])
                    / np.array(values.split(", "), float))
    assert change == pytest.approx(4 * np.log(edit.radius / control), rel=0.4)
    share = float(likely) / (1 + float(likely))
    assert both["young_deviation"]["graph"] == pytest.approx(share**0.5 * change, rel=0.05)
    assert both["young_pa"] == pytest.approx(alone["young_pa"], rel=0.01)
    width, before = (np.diff(np.log(each["young_interval_pa"]), axis=1) for each in (both, alone))
    assert np.all(width > before)
    assert any(cause["cause"] == "skeleton of the scan" for cause in both["causes"])


@pytest.mark.slow
def test_one_without_an_estimate_is_named(branch_folder, capsys, monkeypatch):
    skeleton, _ = thicker(branch_folder)
    far = DeleteBranch(at=tuple(map(float, skeleton.nodes[0] + 50.0)))
    monkeypatch.setattr(other_skeletons, "_graphs",
                        lambda _: [other_skeletons._Graph(2, 0.3, [far])])
    found = estimated(branch_folder, capsys)
    assert found["young_deviation"]["graph"] is None
    assert any("There is no estimate for it" in text for text in found["warnings"])


def test_only_alternatives_that_matter_are_fitted(branch_folder):
    branch = Branch.open(branch_folder)
    here = [0.0, 0.0, 0.1]
    known = [{"probability": 0.6, "edits": []},
             {"probability": 0.2, "edits": [{"do": "delete", "at": here}]},
             {"probability": 0.1, "edits": [{"do": "root", "at": here}]},
             {"probability": 0.02, "edits": [{"do": "root", "at": here}]}]
    branch.made.result["alternatives"] = known
    found = other_skeletons._graphs(branch)
    assert [graph.number for graph in found] == [3]
    assert found[0].odds == pytest.approx(1 / 6)
