"""`limber verify`: names each damaged file, and what is there beside."""

from functools import partial
from pathlib import Path

import pytest
from tests.subjects.commands import answer

from limber.store import Branch


@pytest.fixture
def branch(tmp_path: Path) -> Branch:
    branch = Branch.create(tmp_path / "apple.branch")
    with branch.stage("pull:a") as stage:
        for number in range(7):
            stage.path(f"pulls/a/clouds/{number}.ply").write_text(f"cloud {number}")
    return branch


@pytest.fixture
def verify():
    """The command's exit code and what it says."""
    return partial(answer, "verify")


def test_a_whole_folder_verifies(branch: Branch, verify):
    """With its UUID and size; files of others and streams left by a kill are named, no damage."""
    (branch.folder / "notes.txt").write_text("mine")
    with branch.stream("pulls/b/robot.csv") as stream:
        stream.append("time")
    code, said = verify(branch.folder)
    assert (code, said["status"]) == (0, "done")
    assert (said["uuid"], said["file_count"], said["byte_count"]) == (branch.uuid, 7, 49)
    assert said["unlisted"] == ["notes.txt"]
    assert said["unfinished_streams"] == ["pulls/b/robot.csv"]


def test_each_damaged_file_is_named(branch: Branch, verify):
    """Changed, cut off or gone: all of them, with exit code 2."""
    clouds = branch.folder / "pulls" / "a" / "clouds"
    for number in (0, 1):
        (clouds / f"{number}.ply").write_text("CLOUD 0")
    for number in (2, 3):
        (clouds / f"{number}.ply").write_text("cl")
    for number in (4, 5):
        (clouds / f"{number}.ply").unlink()
    code, said = verify(branch.folder)
    assert (code, said["status"]) == (2, "failed")
    for number, trouble in enumerate(["other content"] * 2 + ["2 bytes instead of 7"] * 2
                                     + ["missing"] * 2):
        assert f"pulls/a/clouds/{number}.ply ({trouble}" in said["error"]
    assert "6.ply" not in said["error"]
    assert "pull:a" in said["error"]


def test_no_branch_folder_is_an_input_error(tmp_path: Path, verify):
    assert verify(tmp_path)[0] == 2
