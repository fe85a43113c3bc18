"""Ten estimates in a row on one branch, as a lab makes them in a week."""

import json

import numpy as np
import pytest
from tests.stages.specified import Fit, SpecifiedPull

from limber.estimation import next_pull
from limber.estimation.settings import FitSpec, PullSpec
from limber.stages.pulls.suggest_pull import SuggestPull
from limber.stages.shape.edit_skeleton import ReviewSkeleton
from limber.stages.shape.generate import Generate
from limber.stages.shape.reconstruct import Reconstruct

QUICK = FitSpec(key_frames=4, mesh_check=False, shapes=0, hold_out=False, fractions=(0.3, 0.7))
LENGTH = 0.4


@pytest.mark.slow
def test_ten_estimates_in_a_row(tmp_path, monkeypatch, seed=11):
    """Of one pull and of several together, after suggested pulls, an edit of the skeleton and a
    change of density: each ends and explains its pulls, nothing new gives the same digits, and
    what a suggested pull narrows is foretold."""
    monkeypatch.setattr(next_pull, "_DIRECTIONS", 2)
    monkeypatch.setattr(next_pull, "_GOOD", 1)
    folder, scan, edits = (tmp_path / name for name in ("lab.branch", "scan", "edits.json"))
    Generate(folder=scan, length=LENGTH, fork_count=1, point_spacing=0.005, seed=seed).run()
    made = {"cloud": scan / "cloud.ply", "output": folder, "root": "auto", "mesh_spacing": 6.0}
    Reconstruct(**made).run()

    def pulled(name, reach=0.35):
        settings = PullSpec(cell_errors="realistic", seed=seed + int(name), frames=8, model="rod",
                            reach=reach, known={"force_bias_sigma_n": 0.05,
                                                "point_sigma_m": 1e-3})
        SpecifiedPull.of(settings, branch_folder=folder, name=name).run()

    def estimated(*names, force=False):
        Fit.of(QUICK, branch_folder=folder, pull=names, force=force).run()
        found = json.loads((folder / "estimate.json").read_text(encoding="utf-8"))
        assert found["converged"] and found["variance_factor"] < 1.5
        return found

    def narrowed(*names):
        """Estimate with one more pull, as suggested; the half widths are those foretold."""
        best = SuggestPull(branch_folder=folder, fractions=(0.92,)).run()["best"]
        pulled(names[-1], best["travel_m"] / (0.92 * LENGTH))
        found = estimated(*names)
        widths = np.diff(np.log(found["young_interval_pa"]))[:, 0] / 2
        assert widths == pytest.approx(1.96 * np.array(best["young_deviation"]), rel=0.15)
        return found["young_pa"]

    pulled("1")
    first = estimated("1")
    assert estimated("1") == first
    again = estimated("1", force=True)
    assert all(again[name] == first[name] for name in ("young_pa", "young_interval_pa", "density"))
    narrowed("1", "2")
    at = estimated("2")["control_points_m"][1]
    edits.write_text(json.dumps([{"do": "confirm", "at": at}]), encoding="utf-8")
    ReviewSkeleton(branch_folder=folder, edits=edits, frame="branch").run()
    estimated("1", "2")
    Reconstruct(**made, density=800.0).run()
    assert estimated("1", "2")["initial"]["density"] == 800.0
    three = narrowed("1", "2", "3")
    estimated("3")
    assert estimated("1", "2", "3")["young_pa"] == three
