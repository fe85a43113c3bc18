"""The report on folders that are not finished, and its refusals; a finished one: test_pipeline."""

import json

import numpy as np
import pytest

from limber.core.errors import BranchFolderError, InputError
from limber.geometry.cloud.cloud import Cloud
from limber.geometry.io.skeletons import write_cylinders
from limber.geometry.skeleton.skeleton import UNRESOLVED, Skeleton
from limber.geometry.tets.tree_sweep import straight_beam
from limber.results.report.estimate_figures import young_along_branch
from limber.results.report.report_tables import (
    cause_rows,
    deviation_rows,
    held_out_rows,
    held_sentence,
    leg_rows,
    modulus_rows,
    true_moduli,
)
from limber.results.scene.animation import young_graph
from limber.stages.paths.plan import Plan
from limber.stages.registry import result_of
from limber.stages.results.report import WriteReport, page_of
from limber.store import Branch

pytestmark = pytest.mark.usefixtures("unpainted")


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
    result = WriteReport(branch_folder=meshed.folder).run()
    html = (meshed.folder / "report.html").read_text(encoding="utf-8")
    assert result["sections"] == ["What was found", "Summary", "Mesh", "How it was made"]
    assert "Young&#39;s modulus has not been estimated" in html
    assert "Young&#39;s modulus along the branch" in html
    for command in ("limber reconstruct", "limber estimate", "limber energy", "limber plan"):
        assert command in html
    assert "<title>beam &amp; co" in html


def test_a_page_of_an_unchanged_folder_is_left_as_it_is(meshed: Branch):
    """Drawn again when something has been added, or when its page is damaged."""
    first = WriteReport(branch_folder=meshed.folder).run()
    entry = Branch.open(meshed.folder).manifest.stages["report"]
    assert WriteReport(branch_folder=meshed.folder).run() == first
    assert Branch.open(meshed.folder).manifest.stages["report"] == entry
    page = meshed.folder / "report.html"
    drawn = page.stat().st_ino
    page.write_text("torn")
    WriteReport(branch_folder=meshed.folder).run()
    assert page.stat().st_ino != drawn  # clocks are too coarse: it is drawn within milliseconds
    with meshed.stage("note") as stage:
        stage.result["said"] = "something"
    entry = Branch.open(meshed.folder).manifest.stages["report"]
    WriteReport(branch_folder=meshed.folder).run()
    assert Branch.open(meshed.folder).manifest.stages["report"] != entry


def test_a_picture_comes_into_a_page_that_is_drawn(meshed: Branch, tmp_path, monkeypatch):
    """As into a new one, without drawing the rest again."""
    from limber.results.report import page as page_module

    picture = tmp_path / "scene.png"
    picture.write_bytes(b"\x89PNG made")
    page = meshed.folder / "report.html"
    new = WriteReport(branch_folder=meshed.folder, picture=picture).run()
    html = page.read_text()
    assert html.index("Rendered scene.") < html.index('<section id="part2">')
    plain, without = WriteReport(branch_folder=meshed.folder).run(), page.read_text()
    assert plain["figure_count"] == new["figure_count"] - 1
    monkeypatch.setattr(page_module, "draw_page", None)
    assert WriteReport(branch_folder=meshed.folder, picture=picture).run() == new
    lines = page.read_text().splitlines()
    assert [line for line in lines if "Rendered scene." not in line] == without.splitlines()


def test_an_execution_shows_felt_beside_predicted(meshed: Branch):
    """A log of the robot becomes a table and a picture; one without a prediction says so."""
    from limber.robot.driver.link import COLUMNS

    rows = np.full((400, len(COLUMNS)), np.nan)
    rows[:, :25] = 0.0
    rows[:, 0] = np.arange(400) * 0.002
    rows[100:, 25:28] = rows[100:, 13:16] = np.linspace(0, 3, 300)[:, None]
    rows[100:, 31:37] = 0.01

    def executed(name: str, table: np.ndarray) -> None:
        with meshed.stage(f"execute:{name}") as stage:
            lines = [",".join("" if np.isnan(x) else f"{x:g}" for x in row) for row in table]
            stage.path(f"executions/{name}/samples.csv").write_text(
                "\n".join([",".join(COLUMNS), *lines]) + "\n", encoding="utf-8")
            stage.result.update(armed=True, reached=name == "led", stop_reason="slipped",
                                peak_force_n=5.2, force_within_share=0.99, path_error_m=None)
    executed("led", rows)
    executed("lost", rows[:100])
    html, page = page_of(meshed)
    led, lost = (section for section in page if section.title.startswith("Executed by the robot"))
    assert len(led.pictures) == 1 and ["measured peak force [N]", "5.20"] in led.tables[0][1]
    assert not lost.pictures and "no predicted force" in lost.text[0]
    assert ["stopped", "slipped"] in led.tables[0][1] and "0.99" not in html


def test_picture_must_be_a_png(meshed: Branch, tmp_path):
    """Another file, or none, is refused with its name; no report is left behind."""
    (tmp_path / "x.png").write_bytes(b"JFIF")
    for picture in (tmp_path / "x.png", tmp_path / "none.png"):
        with pytest.raises(InputError, match=picture.name):
            WriteReport(branch_folder=meshed.folder, picture=picture).run()
    assert not (meshed.folder / "report.html").exists()


def test_damaged_mesh_is_named(meshed: Branch):
    """A damaged file is reported by name, not drawn."""
    with open(meshed.folder / "mesh.vtu", "a", encoding="utf-8") as stream:
        stream.write(" ")
    with pytest.raises(BranchFolderError, match=r"mesh\.vtu"):
        WriteReport(branch_folder=meshed.folder).run()


def test_tables_without_truth_or_numbers():
    """A real pull has no truth columns; an undetermined interval and an absent measure say so."""
    estimate = {"young_pa": [2e6, 3e6], "young_interval_pa": [[1e6, 4e6], [None, None]]}
    rows = modulus_rows(estimate, None)
    assert rows == [["control point", "E [MPa]", "95 % interval [MPa]"],
                    ["1", "2", "1 to 4"], ["2", "3", "undetermined"]]
    plan = {"baseline": {"length_m": 0.5, "peak_force_n": None}, "plan": {"length_m": 0.55}}
    assert Plan.of(plan).comparison()[1:] == [["path length [m]", "0.5", "0.55", "+10.0 %"]]


def test_the_legs_of_a_motion_stand_in_order():
    """Where the gripper stands there is neither way nor speed; what is not known stays empty."""
    path = {"name": "path", "start_s": 4.0, "duration_s": 12.25, "length_m": 0.2,
            "peak_speed_m_s": 0.02, "peak_force_n": 1.234, "obstacle_distance_m": 0.1,
            "branch_distance_m": -0.004}
    hold = {"name": "hold", "start_s": 16.2, "duration_s": 2.0, "length_m": 0.0,
            "peak_speed_m_s": 0.0, "peak_force_n": 1.2}
    assert leg_rows([path, hold])[1:] == [["path", "4.0", "12.2", "200", "20", "1.23", "100", "-4"],
                                          ["hold", "16.2", "2.0", "", "", "1.2", "", ""]]
    assert leg_rows([]) == []


def test_a_known_truth_tells_how_far_the_intervals_held():
    estimate = {"young_pa": [2e6, 3e6, 1e6],
                "young_interval_pa": [[1e6, 4e6], [2.5e6, 3.5e6], [None, None]]}
    pull = {"young_true_pa": [3e6, 4e6, 1e6]}
    rows = modulus_rows(estimate, pull)
    assert [row[-1] for row in rows] == ["in the interval", "yes", "NO", "NO"]
    assert held_sentence(estimate, pull).startswith("1 of 3 ")
    assert "true E [MPa]" in rows[0] and held_sentence(estimate, pull).endswith("true modulus.")


def test_an_assumed_modulus_is_never_called_true():
    """A simulated pull of a scan that nobody pulled: its modulus is assumed, in every word."""
    estimate = {"young_pa": [2e6], "young_interval_pa": [[1e6, 4e6]]}
    pull = {"young_true_pa": [3e6], "young_assumed": True}
    told = " ".join(modulus_rows(estimate, pull)[0]) + held_sentence(estimate, pull)
    assert "assumed E [MPa]" in told and "This branch was not pulled" in told
    assert "true" not in told and "error" not in told
    curve = {"fractions": [0.2, 0.8], "young_pa": [2e6, 1e6],
             "young_interval_pa": [[1e6, 3e6], [5e5, 2e6]]}
    for assumed in (False, True):
        truth = {"fractions": [0.2, 0.8], "young_pa": [2e6, 1e6], "assumed": assumed}
        word = "assumed" if assumed else "true"
        drawn = young_graph(curve | {"truth": truth})
        assert word in [line["label"] for line in drawn["lines"]]
        figure = young_along_branch(curve | {"truth": truth})
        assert word in [text.get_text() for text in figure.legends[0].get_texts()]


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


def test_what_holds_an_estimate_back_is_read_first(meshed: Branch):
    """What was found in a sentence, then causes with what would shrink each."""
    estimate = {"causes": [
        {"cause": "gripper frame", "share": 0.6, "deviation": 0.12, "advice": "calibrate it"},
        {"cause": "force gain", "share": 0.3, "deviation": 0.08, "advice": "hang a known weight"}]}
    assert cause_rows(estimate)[1:] == [
        ["gripper frame", "60 %", "up to 12.0 %", "calibrate it"],
        ["force gain", "30 %", "up to 8.0 %", "hang a known weight"]]
    assert cause_rows({"causes": []}) == [] == cause_rows({})
    full = estimate | {
        "young_pa": [1e9], "young_interval_pa": [[8e8, 1.2e9]], "fractions": [0.5],
        "young_deviation": {"sensor": [0.14], "geometry": None, "mesh": None, "total": [0.14]},
        "method": "gauss-newton", "forward_count": 1, "loss_m2": 1e-6, "converged": True,
        "warnings": [], "history": [], "pulls": [], "groups": [0], "parameters": ["E1"],
        "covariance": [[0.02]], "deviations_before_fit": [0.2], "poisson": 0.35,
        "control_points_m": [[0.0, 0.0, 0.2]]}
    with meshed.stage("estimate") as stage:
        stage.path("estimate.json").write_text(json.dumps(full), encoding="utf-8")
    result = WriteReport(branch_folder=meshed.folder).run()
    assert result["sections"][:3] == ["What was found", "What limits the estimate", "Summary"]
    html = (meshed.folder / "report.html").read_text(encoding="utf-8")
    assert html.index("from base to tip: 1,000 (800 to 1,200) MPa") < html.index("calibrate it")
    assert html.index("calibrate it") < html.index("Summary</h2>") and "14.0 %" in html


@pytest.mark.slow
def test_named_targets_stand_in_figure_and_table(tmp_path):
    """The place of a flower is a row of the scan's table."""
    import shutil
    from pathlib import Path

    from limber.stages.shape.target import SetTarget

    example = Path(__file__).parents[3] / "blend_files" / "bending_branch"
    folder = shutil.copytree(example, tmp_path / "example.branch")
    branch = Branch.open(folder)
    tip = np.loadtxt(branch.path("skeleton.swc"))[-1, 2:5]
    SetTarget(branch_folder=folder, name="flower", at=tuple(tip), mass=0.02).run()
    WriteReport(branch_folder=folder).run()
    html = (folder / "report.html").read_text(encoding="utf-8")
    assert "Named targets" in html and ">flower<" in html and f"{tip[2]:.3f}" in html


@pytest.mark.slow
def test_cylinder_model_stands_beside_calipers(tmp_path):
    """Orders, diameters, how radii are known, doubt; a caliper's value, and one off the branch."""
    tree = Skeleton.from_edges(
        np.array([[0, 0, 0], [0, 0, 0.2], [0, 0, 0.4], [0.1, 0, 0.3]], float),
        np.array([-1, 0, 1, 1]), np.array([0.012, 0.01, 0.008, 0.004]),
        radius_sigma=np.array([0, 2e-4, 2e-4, 1e-3]), radius_state=np.array([0, 0, 0, UNRESOLVED]),
        probability=np.array([1, 1, 1, 0.4]))
    branch = Branch.create(tmp_path / "a.branch")
    with branch.stage("reconstruct") as stage:
        tree.write_swc(stage.path("skeleton.swc"))
        write_cylinders(tree, stage.path("skeleton.csv"))
        Cloud(tree.nodes).write_ply(stage.path("cloud.ply"))
        stage.result["length_shares"] = {"measured": 0.74, "unresolved": 0.26}
    path = tmp_path / "calipers.csv"
    path.write_text("along_m,diameter_mm\n0.2,21.0\n")
    result = WriteReport(branch_folder=branch.folder, caliper=path).run()
    assert "Cylinder model" in result["sections"]
    (row,) = result["calipers"]
    assert row["difference"] == pytest.approx(20 / 21 - 1)
    assert row["sigmas"] == pytest.approx(-0.001 / 4e-4)
    html = (branch.folder / "report.html").read_text(encoding="utf-8")
    for text in ("74.0 %", "26.0 %", "probability 0.40", "sigma 25% of the radius", "-4.8 %",
                 "-2.5", "By branching order", "taper [mm of radius per m]"):
        assert text in html, text
    for content, told in (("along_m,diameter_mm\n0.5,21\n", "0.5 m, but the main path is 0.4 m"),
                          ("along_m,diameter_mm\n0.1,-3\n", "line 2: -3 mm"), ("", "no values")):
        path.write_text(content)
        with pytest.raises(InputError, match=told):
            WriteReport(branch_folder=branch.folder, caliper=path).run()


def test_a_swing_has_a_section(meshed):
    """What it told, with intervals, and the track it was laid over."""
    times = np.linspace(0.0, 1.0, 30)
    track = 0.02 * np.cos(20 * times)[:, None, None] * [[[0, 0, 0.1], [0, 0.5, 1.0]]]
    swing = {"pull": "let-go", "young_pa": 2.5e6, "young_interval_pa": [2.4e6, 2.7e6],
             "damping_ratio": 0.05, "damping_ratio_interval": [0.04, 0.06], "release_s": 0.4,
             "release_deviation_s": 0.01, "frequency_hz": 3.2, "relative_residual": 0.012,
             "warnings": ["a word"], "times_s": times.tolist(), "seen_m": (track + 1e-4).tolist(),
             "simulated_m": track.tolist()}
    with meshed.stage("swing") as stage:
        stage.path("swing.json").write_text(json.dumps(swing), encoding="utf-8")
        stage.result = {key: value for key, value in swing.items() if key[-2:] != "_m"}
    rows = result_of(meshed, "swing", meshed.manifest.stages["swing"].result).rows()
    assert rows[1] == ["Young's modulus, mean [MPa]", "2.5", "2.4 to 2.7"]
    assert rows[3][:2] == ["time of release [s]", "0.4"]
    page, sections = page_of(meshed)
    found = next(section for section in sections if section.title == "Swing let-go")
    assert len(found.pictures) == 1 and found.text == ["a word"] and "2.4 to 2.7" in page


def test_a_deviation_that_is_not_known_is_told_so():
    rows = deviation_rows({"fractions": [0.2, 0.8], "young_deviation": {
        "sensor": [0.1, None], "geometry": None, "mesh": None, "total": [0.1, 0.2]}})
    assert rows[2][2:] == ["not known", "not examined", "not examined", "20.0 %"]


def test_the_truth_is_compared_at_the_control_points_of_the_estimate():
    """The true field between its own control points has the paper's inverse-distance weights."""
    pull = {"young_true_pa": [4e7, 1e7], "fractions": [0.25, 0.75]}
    estimate = {"young_pa": [3e7, 2e7, 1e7], "fractions": [0.25, 0.5, 0.6],
                "young_interval_pa": [[2e7, 5e7], [1e7, 2e7], [1e7, 2e7]]}
    near, far = 1 / 0.15**2, 1 / 0.35**2
    assert true_moduli(estimate, pull) == pytest.approx(
        [4e7, 2.5e7, (1e7 * near + 4e7 * far) / (near + far)])
    assert held_sentence(estimate, pull).startswith("2 of 3 ")
    assert true_moduli({"young_pa": [1e7]}, pull) == []
