"""Force against displacement."""

import json
from pathlib import Path

import numpy as np
import pytest
from tests.stages.specified import Fit

from limber.cli.main import call
from limber.core.errors import InputError
from limber.mechanics.model import BranchModel
from limber.mechanics.statics.solve import solve_static
from limber.recordings.force_slope import force_slope, read_force_displacement
from limber.recordings.recording import GraspEntry, grasp_on, read_pull
from limber.store import Branch
from limber.store.loading import load_mesh, load_skeleton

DATA = Path(__file__).parents[1] / "data" / "blueberry_cane_push"


def columns(table):
    return table.displacement, table.force


def test_slope_contact_and_offset_of_a_known_push():
    """A hinge with offset and noise: slope, contact and reading without load come back."""
    rng = np.random.default_rng(0)
    way = np.arange(0.10, 0.16, 0.0005)
    force = -0.5 + 80 * np.maximum(way - 0.115, 0) + 0.03 * rng.standard_normal(len(way))
    found = force_slope(way, force)
    assert found.slope == pytest.approx(80, rel=0.02)
    assert found.interval[0] < 80 < found.interval[1]
    assert found.contact == pytest.approx(0.115, abs=2e-3)
    assert found.baseline == pytest.approx(-0.5, abs=0.05)
    assert any("not tared" in w for w in found.warnings)


def test_interval_covers_as_often_as_it_says():
    """Over 200 seeds with noise that follows itself, about 95 % of intervals hold the slope."""
    hits = 0
    way = np.arange(0.0, 0.05, 0.0005)
    for seed in range(200):
        rng = np.random.default_rng(seed)
        noise = np.zeros(len(way))
        for k in range(1, len(way)):
            noise[k] = 0.4 * noise[k - 1] + 0.02 * rng.standard_normal()
        found = force_slope(way, 60 * np.maximum(way - 0.01, 0) + noise)
        hits += found.interval[0] < 60 < found.interval[1]
    assert 170 <= hits <= 200


def test_a_push_that_meets_nothing():
    """Noise alone has no slope, and says so."""
    rng = np.random.default_rng(0)
    with pytest.raises(InputError, match="noise"):
        force_slope(np.arange(0, 0.05, 0.0005), 0.03 * rng.standard_normal(100))


def test_units_come_from_the_header(tmp_path):
    """Gram-force and millimetres are read as such; a number without unit is refused."""
    rows = "".join(f"{100 * k},{k}\n" for k in range(6))
    path = tmp_path / "a.csv"
    path.write_text("Load Cell Reading (gf),Displacement (mm)\n" + rows)
    way, force = columns(read_force_displacement(path))
    assert force[1] == pytest.approx(0.980665) and way[1] == pytest.approx(1e-3)
    path.write_text("force,displacement_mm\n" + rows)
    with pytest.raises(InputError, match="unit"):
        read_force_displacement(path)


def test_incomplete_rows_are_dropped_with_a_word(tmp_path):
    """A recording that ends in the middle of a line gives its slope nevertheless."""
    rows = "".join(f"{0.1 * k},{k}\n" for k in range(8))
    path = tmp_path / "a.csv"
    path.write_text("force (N),displacement (mm)\n" + rows + "0.9")
    table = read_force_displacement(path)
    assert len(table.force) == 8 and "incomplete" in table.warnings[0]


def test_recorded_canes():
    """27 pushes of living canes: each has a positive slope within its interval, near that of a
    plain line through what lies over the noise.
    """
    files = sorted(DATA.glob("*.csv"))
    assert len(files) == 27
    off = []
    for path in files:
        table = read_force_displacement(path)
        way, force = columns(table)
        found = force_slope(way, force, warnings=table.warnings)
        over = force > 20 * 9.80665e-3
        plain = np.polyfit(way[over], force[over], 1)[0]
        assert 10 < found.interval[0] < found.slope < found.interval[1] < 2000
        off.append(abs(found.slope / plain - 1))
    assert np.median(off) < 0.03 and max(off) < 0.25


def push(rng, slope=150.0, contact=0.115, noise=0.02):
    way = np.arange(0.10, 0.15, 0.0005)
    return way, slope * np.maximum(way - contact, 0) + noise * rng.standard_normal(len(way))


def test_the_way_back_and_what_is_lost():
    """Out with 150 N/m and back with 120 N/m: both slopes, and the share of work that is lost."""
    rng = np.random.default_rng(2)
    way, force = push(rng)
    top = force[-1]
    back = way[::-1][1:]
    returned = np.maximum(top - 160.0 * (way[-1] - back), 0.0)
    found = force_slope(np.r_[way, back], np.r_[force, returned])
    assert found.slope == pytest.approx(150, rel=0.03)
    assert found.return_slope == pytest.approx(160, rel=0.05)
    assert 0.02 < found.energy_lost < 0.2
    assert force_slope(way, force).return_slope is None


@pytest.mark.parametrize(("turn_way", "turn_force"), [(1, -1), (-1, 1), (-1, -1)])
def test_signs_are_turned_by_the_work_done(turn_way, turn_force):
    """A sensor that counts pressure negative, an actuator that counts down: told and turned."""
    way, force = push(np.random.default_rng(3))
    found = force_slope(turn_way * way, turn_force * force)
    assert found.slope == pytest.approx(150, rel=0.03)
    assert any("reversed" in warning for warning in found.warnings)


def test_spike_saturation_and_slip_are_told_apart():
    """A single reading far off and a flat top are left out; a slip stays, with the slope before."""
    way, force = push(np.random.default_rng(4))
    spoiled = force.copy()
    spoiled[50] += 4.0
    spoiled = np.minimum(spoiled, 4.0)
    found = force_slope(way, spoiled)
    text = " ".join(found.warnings)
    assert "spike" in text and "saturated" in text
    assert found.slope == pytest.approx(150, rel=0.03)
    slipped = force - 1.5 * (way > 0.135)
    found = force_slope(way, slipped)
    assert found.slips and found.slips[0] == pytest.approx(0.135, abs=6e-4)
    assert found.slope_before_slip == pytest.approx(150, rel=0.03)
    assert found.interval[1] - found.interval[0] > 30


def test_a_push_that_starts_loaded_says_so():
    """Without a reading before contact there is none to report; the slope is right."""
    way, force = push(np.random.default_rng(5), contact=0.09)
    found = force_slope(way, force)
    assert not found.contact_seen and any("already loaded" in w for w in found.warnings)
    assert found.slope == pytest.approx(150, rel=0.03)


@pytest.mark.parametrize(("header", "row", "newtons", "metres"), [
    ("Iteration,Time Stamp,Load Cell Reading (gf),Displacement (mm),Height (mm)",
     "{k},0,{f},{d},900", 9.80665e-3, 1e-3),
    ("displacement_mm;force_n", "{d};{f}", 1.0, 1e-3),
    ("Stroke [cm]\tLoad [lbf]", "{d}\t{f}", 4.4482216, 1e-2),
    ("deflection (in),force (mN)", "{d},{f}", 1e-3, 0.0254),
])
def test_headers_of_other_load_cells(tmp_path, header, row, newtons, metres):
    """Names, separators, order and units of columns vary; numbers come out in newtons and metres.
    """
    rows = "".join(row.format(k=k, f=10 + k, d=0.5 * k) + "\n" for k in range(8))
    path = tmp_path / "a.csv"
    path.write_text(f"{header}\n{rows}")
    way, force = columns(read_force_displacement(path))
    assert force[2] == pytest.approx(12 * newtons) and way[2] == pytest.approx(metres)


def test_every_recorded_push_through_the_command(tmp_path, capsys):
    """All 27: a slope within its interval, contact on the way, and the reason why no modulus."""
    for path in sorted(DATA.glob("*.csv")):
        assert call(["import-pull", str(tmp_path / "cane.branch"), str(path), "--name", path.stem,
                     "--json", "--progress", "none"]) == 0
        line = json.loads(capsys.readouterr().out.strip().splitlines()[-1])
        low, high = line["slope_interval_n_per_m"]
        assert low < line["slope_n_per_m"] < high and line["kind"] == "force-displacement"
        way = np.loadtxt(tmp_path / "cane.branch" / "pulls" / path.stem / "force.csv",
                         delimiter=",", skiprows=1)[:, 0]
        assert way.min() <= line["contact_m"] < way.mean()
        assert "fourth power" in line["why_no_modulus"]


def test_the_first_contact_counts_not_an_obstacle_behind_it():
    """A cane, then a trellis wire twenty times as stiff: the slope is the cane's, and what was
    left out is told."""
    rng = np.random.default_rng(3)
    way = np.arange(0.0, 0.08, 0.0005)
    force = (60 * np.maximum(way - 0.02, 0) + 1200 * np.maximum(way - 0.06, 0)
             + 0.02 * rng.standard_normal(len(way)))
    found = force_slope(way, force)
    assert found.slope == pytest.approx(60, rel=0.05)
    assert found.contact == pytest.approx(0.02, abs=3e-3)
    assert any("discarded" in message and "first contact" in message for message in found.warnings)


# A test with force gauge and ruler: three columns, distance from the base, force, displacement.

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


def test_a_force_along_the_branch_is_refused(branch_folder, table, capsys):
    """A standing branch that is pushed down, as the default is, would only be squeezed."""
    assert imported(branch_folder, table, "--direction", "0", "0", "-1") == 2
    assert "stretches or squeezes" in capsys.readouterr().out
    assert not (branch_folder / "pulls" / "gauge").exists()


@pytest.mark.slow
def test_a_gauge_and_a_ruler_give_the_modulus(branch_folder, table):
    """Of one slope only the common scale is known: the moduli between are assumed to vary."""
    assert imported(branch_folder, table) == 0
    line = Fit(branch_folder=branch_folder, pull=("gauge",), fractions=(0.4,), gravity=False,
               quick=True).run()
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
