"""The report on folders that are not finished, and its refusals; a finished one: test_pipeline."""

import numpy as np
import pytest

from limber.errors import BranchFolderError, InputError
from limber.geometry.tets.cylinder_mesh import straight_beam
from limber.report.tables import comparison_rows, deviation_rows, held_out_rows, modulus_rows
from limber.stages.report import write_report
from limber.store import Branch


@pytest.fixture
def meshed(tmp_path) -> Branch:
    """A branch folder with a mesh and nothing else."""
    branch = Branch.create(tmp_path / "beam & co.branch")
    with branch.stage("mesh") as stage:
        straight_beam(0.3, 0.006, 0.004).write(stage.path("mesh.vtu"))
        stage.result.update(tet_count=1)
    return branch


def test_unfinished_folder_says_what_is_missing(meshed: Branch):
    """Each part that has not been done names the command that does it; the name is escaped."""
    result = write_report(meshed.folder)
    html = (meshed.folder / "report.html").read_text(encoding="utf-8")
    assert result["sections"] == ["Summary", "Mesh", "How it was made"]
    assert "Young&#39;s modulus along the branch" in html
    for command in ("limber reconstruct", "limber estimate", "limber energy", "limber plan"):
        assert command in html
    assert "<title>beam &amp; co" in html


def test_picture_must_be_a_png(meshed: Branch, tmp_path):
    """Another file, or none, is refused with its name; no report is left behind."""
    (tmp_path / "x.png").write_bytes(b"JFIF")
    for picture in (tmp_path / "x.png", tmp_path / "none.png"):
        with pytest.raises(InputError, match=picture.name):
            write_report(meshed.folder, picture=picture)
    assert not (meshed.folder / "report.html").exists()


def test_damaged_mesh_is_named(meshed: Branch):
    """A damaged file is reported by name, not drawn."""
    with open(meshed.folder / "mesh.vtu", "a", encoding="utf-8") as stream:
        stream.write(" ")
    with pytest.raises(BranchFolderError, match=r"mesh\.vtu"):
        write_report(meshed.folder)


def test_tables_without_truth_or_numbers():
    """A real pull has no truth columns; an undetermined interval and an absent measure say so."""
    estimate = {"young_pa": [2e6, 3e6], "young_interval_pa": [[1e6, 4e6], [None, None]]}
    rows = modulus_rows(estimate, None)
    assert rows == [["control point", "E [MPa]", "95 % interval [MPa]"],
                    ["1", "2", "1 to 4"], ["2", "3", "undetermined"]]
    plan = {"baseline": {"length_m": 0.5, "peak_force_n": None}, "plan": {"length_m": 0.55}}
    assert comparison_rows(plan)[1:] == [["path length [m]", "0.5", "0.55", "+10.0 %"]]


def test_tables_of_what_makes_a_modulus_unsure_and_of_foretold_pulls():
    """Parts in percent, what was not examined said so; a score that was not measured is a dash."""
    estimate = {"fractions": [0.25, 0.5], "young_deviation": {
        "sensor": [0.01, 0.02], "geometry": None, "mesh": [0.005, 0.005], "total": [0.011, 0.021]}}
    assert deviation_rows(estimate)[1:] == [
        ["1", "0.25", "1.0 %", "not examined", "0.5 %", "1.1 %"],
        ["2", "0.50", "2.0 %", "not examined", "0.5 %", "2.1 %"]]
    assert deviation_rows({"fractions": [0.5]}) == []
    scores = {"a": {"rms_m": 0.0012, "rms_force_n": 0.034, "relative_distance": 0.021,
                    "relative_force": 0.04, "in_fit": True},
              "b": {"rms_m": 0.003, "rms_force_n": None, "relative_distance": 0.1,
                    "relative_force": None, "in_fit": False}}
    assert held_out_rows({"held_out": scores})[1:] == [
        ["a", "1.20", "2.1 %", "0.034", "4.0 %", "the other pulls"],
        ["b", "3.00", "10.0 %", "-", "-", "this estimate"]]
    assert held_out_rows({"held_out": {}}) == []


def test_named_targets_stand_in_figure_and_table(tmp_path):
    """The place of a flower is a row of the scan's table."""
    import shutil
    from pathlib import Path

    from limber.stages.target import TargetSettings, set_target

    example = Path(__file__).parents[2] / "blend_files" / "bending_branch"
    folder = shutil.copytree(example, tmp_path / "example.branch")
    branch = Branch.open(folder)
    tip = np.loadtxt(branch.path("skeleton.swc"))[-1, 2:5]
    set_target(folder, "flower", TargetSettings(at=tuple(tip), mass=0.02))
    write_report(folder)
    html = (folder / "report.html").read_text(encoding="utf-8")
    assert "Named targets" in html and ">flower<" in html and f"{tip[2]:.3f}" in html
