"""The folder of a pull."""

import numpy as np
import pytest

from limber.core.errors import InputError
from limber.recordings.recording import Observations, read_entry, read_pull, write_pull


def test_pull_round_trip(tmp_path, plain_pull):
    """Everything that was recorded comes back, unseen markers included."""
    positions = plain_pull.observations.positions.copy()
    positions[3, 1] = np.nan
    from dataclasses import replace

    pull = replace(plain_pull, observations=Observations(plain_pull.observations.times, positions))
    write_pull(tmp_path / "spring", pull)
    again = read_pull(tmp_path / "spring")
    assert again.entry == pull.entry and again.name == "spring" and not again.warnings
    assert np.allclose(again.poses, pull.poses) and np.allclose(again.wrenches, pull.wrenches)
    assert np.allclose(again.observations.positions, positions, equal_nan=True)
    assert not again.observations.visible[3, 1] and again.observations.visible[3, 0]


def test_entries_are_checked_by_name(tmp_path, plain_pull):
    """A wrong entry of pull.toml is named; a missing file says how to make one."""
    write_pull(tmp_path / "p", plain_pull)
    path = tmp_path / "p" / "pull.toml"
    text = path.read_text()
    path.write_text(text.replace('mode = "rigid"', 'mode = "glued"'))
    with pytest.raises(InputError, match=r"grasp\.mode"):
        read_entry(path)
    for support, mode in (("clamped", "rigid"), ("pinned", "point")):  # words of beam theory
        path.write_text(text.replace('mode = "rigid"', f'mode = "{support}"'))
        assert read_entry(path).grasp.mode == mode
    path.write_text(text + "\nunknown = 3\n")
    with pytest.raises(InputError, match="unknown"):
        read_entry(path)
    with pytest.raises(InputError, match="import-pull"):
        read_entry(tmp_path / "none.toml")


def test_missing_columns_and_missing_wrench(tmp_path, plain_pull):
    """Poses are needed and asked for by name; a wrench may be missing and is then NaN."""
    write_pull(tmp_path / "p", plain_pull)
    robot = tmp_path / "p" / "robot.csv"
    lines = [line.split(",") for line in robot.read_text().splitlines()]
    robot.write_text("\n".join(",".join(row[:7]) for row in lines) + "\n")
    assert np.isnan(read_pull(tmp_path / "p").wrenches).all()
    robot.write_text("\n".join(",".join(row[:6]) for row in lines) + "\n")
    with pytest.raises(InputError, match="rz_rad"):
        read_pull(tmp_path / "p")


def test_markers_in_millimetres_are_not_taken_for_metres(tmp_path, plain_pull):
    """Columns whose names do not say metres are refused, not guessed."""
    write_pull(tmp_path / "p", plain_pull)
    markers = tmp_path / "p" / "markers.csv"
    markers.write_text(markers.read_text().replace("_m,", "_mm,", 6))
    with pytest.raises(InputError, match="import-pull --unit"):
        read_pull(tmp_path / "p")
