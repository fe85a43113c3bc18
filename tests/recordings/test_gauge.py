"""A test with force gauge and ruler: three columns, distance from the base, force, displacement."""

import json

import numpy as np
import pytest

from limber.cli.main import call
from limber.core.errors import InputError
from limber.mechanics.model import BranchModel
from limber.mechanics.statics.solve import solve_static
from limber.recordings.force_slope import read_force_displacement
from limber.recordings.recording import GraspEntry, grasp_on, read_pull
from limber.store import Branch
from limber.store.loading import load_mesh, load_skeleton

YOUNG, DISTANCE, SIDEWAYS = 2.5e7, 0.3, np.array([1.0, 0.0, 0.0])
FORCES = np.array([0.0, 0.3, 0.6, 0.9, 1.2])


def grasp_of(folder):
    skeleton = load_skeleton(Branch.read(folder))
    path = skeleton.nodes[skeleton.main_path()]
    along = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))]
    return np.array([np.interp(DISTANCE, along, axis) for axis in path.T])


@pytest.fixture
def table(branch_folder, tmp_path):
    """Gauge to 0.01 N, ruler to 1 mm; the ruler's zero is at 12 mm."""
    mesh, point = load_mesh(Branch.read(branch_folder)), grasp_of(branch_folder)
    model = BranchModel(mesh, young=YOUNG, poisson=0.36, density=900.0, gravity=None)
    grasp = grasp_on(mesh, GraspEntry(point_m=tuple(point), radius_m=0.01, mode="point"))
    rows = ["distance from base (cm);force (N);deflection (mm)"]
    for force in FORCES:
        state = solve_static(model, grasp=grasp, grasp_force=force * SIDEWAYS).require()
        moved = grasp.pose_of(mesh.nodes, state.displacement)[:3] - grasp.centre
        rows.append(f"{100 * DISTANCE:g};{force:.2f};{12 + 1e3 * moved @ SIDEWAYS:.0f}")
    path = tmp_path / "gauge.csv"
    path.write_text("\n".join(rows) + "\n")
    return path


def imported(folder, path, *more):
    return call(["import-pull", str(folder), str(path), "--name", "gauge", "--direction", "1", "0",
                 "0", "--force-sigma", "0.01", "--json", "--progress", "none", *more])


def test_three_columns_are_a_pull(branch_folder, table, capsys):
    assert imported(branch_folder, table) == 0
    line = json.loads(capsys.readouterr().out.strip().splitlines()[-1])
    pull = read_pull(branch_folder / "pulls" / "gauge")
    assert pull.entry.grasp.point_m == pytest.approx(grasp_of(branch_folder), abs=1e-9)
    assert pull.wrenches[:, 0] == pytest.approx(FORCES)
    moved = pull.observations.positions[:, 0] - np.array(pull.entry.grasp.point_m)
    assert moved[0] == pytest.approx(np.zeros(3), abs=1e-8)
    assert np.all(np.diff(moved[:, 0]) > 0) and np.all(np.abs(moved[:, 1:]) < 1e-8)
    assert line["load_n"] == pytest.approx([1.2, 0, 0])


@pytest.mark.slow
def test_a_gauge_and_a_ruler_give_the_modulus(branch_folder, table, capsys):
    """Of one slope only the common scale is known: the moduli between are assumed to vary."""
    assert imported(branch_folder, table) == 0
    assert call(["estimate", str(branch_folder), "--pull", "gauge", "--fractions", "0.4",
                 "--no-gravity", "--quick", "--json", "--progress", "none"]) == 0
    line = json.loads(capsys.readouterr().out.strip().splitlines()[-1])
    (low, high), = line["young_interval_pa"]
    assert low < YOUNG < high and high / low < 2
    assert line["young_pa"][0] == pytest.approx(YOUNG, rel=0.1)


def test_several_distances_are_refused_by_name(branch_folder, table):
    text = table.read_text().replace("30;1.20", "25;1.20")
    table.write_text(text)
    with pytest.raises(InputError, match=r"0\.25, 0\.3 m"):
        read_force_displacement(table)


def test_a_distance_beyond_the_tip_is_refused(branch_folder, table, capsys):
    table.write_text(table.read_text().replace("30;", "900;"))
    assert imported(branch_folder, table) == 2
    assert "main path is" in capsys.readouterr().out
