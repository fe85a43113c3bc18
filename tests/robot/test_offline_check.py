"""`limber robot check --offline`: the files of a cell, without a robot."""


from tests.subjects.commands import robot_answer

from benchmarks.robot_cells import cell_file, standing_at
from limber.cell.cell_file import Cell
from limber.store import Branch


def checked(capfd, *arguments: str) -> tuple[int, dict]:
    return robot_answer(capfd, "check", *arguments)


def test_files_alone_are_checked_without_a_robot(branch_folder, tmp_path, capfd):
    cell = standing_at(Branch.open(branch_folder), "127.0.0.98")
    path = cell_file(cell, tmp_path)
    code, told = checked(capfd, path, "--offline", "--branch", branch_folder)
    assert code == 0 and told["arm"] == "ur5e" and told["calibration_residual_m"] is None
    assert any("was not calibrated by Limber" in text for text in told["warnings"])
    other = cell_file(cell.model_copy(update={"branch": "another"}), tmp_path)
    code, told = checked(capfd, other, "--offline", "--branch", branch_folder)
    assert code == 2 and "calibrated for branch another" in told["error"]
    mesh = Cell(**cell.model_dump(exclude={"obstacles"}), obstacles=[
        {"kind": "mesh", "file": "none.stl", "unit": "m"}])
    path = cell_file(mesh, tmp_path)
    code, told = checked(capfd, path, "--offline")
    assert code == 2 and "none.stl" in told["error"]
    path.write_text("robot = {model = 'ur5e', address = 'ws://a:9090'}\nsensor = {kind = 'ft300'}\n"
                    "base = {pose = [0.6, 0, 0, 0, 0, 0]}\n")
    code, told = checked(capfd, path, "--offline")
    assert code == 2 and "states no sensor.topic" in told["error"]
    path.write_text(path.read_text().replace("9090'", "9090', ros = {trajectry = '/go'}"))
    code, told = checked(capfd, path, "--offline")
    assert code == 2 and "[robot.ros] states trajectry" in told["error"]
    path.write_text("[robot]\nmodel = 'ur9'\n")
    assert checked(capfd, path, "--offline")[0] == 2


def test_a_robot_that_does_not_answer_names_the_offline_check(branch_folder, tmp_path, capfd):
    path = cell_file(standing_at(Branch.open(branch_folder), "127.0.0.98"), tmp_path)
    code, told = checked(capfd, path)
    assert code == 3 and "--offline" in told["fix"]
    code, told = checked(capfd, path, "--plan", "path")
    assert code == 2 and "Give --offline" in told["fix"]


def test_a_plan_is_checked_for_the_cells_arm(planned_folder, tmp_path, capfd):
    """In reach from one base; from two metres away it is refused, without a robot."""
    cell = standing_at(Branch.open(planned_folder), "127.0.0.98")
    code, told = checked(capfd, cell_file(cell, tmp_path), "--offline", "--branch",
                         planned_folder, "--plan", "path")
    assert code == 0 and told["plan"] == "path" and told["motion"]["legs"], told
    away = cell.model_copy(update={"base": cell.base.model_copy(update={
        "pose": (3.0, 0, 0, 0, 0, 0)})})
    code, told = checked(capfd, cell_file(away, tmp_path), "--offline", "--branch",
                         planned_folder, "--plan", "path")
    assert code == 3 and told["error"]
