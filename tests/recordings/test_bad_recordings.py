"""What goes wrong in recordings, each through the command that a user runs."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from limber.cli.main import call
from limber.core.alignment import Alignment
from limber.core.constants import FORCE_UNITS_N
from limber.core.errors import InputError
from limber.geometry.cloud.camera import D455, write_camera
from limber.perception.observe import write_depth
from limber.recordings.recording import Observations, read_pull, write_pull
from limber.recordings.sensor_checks import clean, force_unit_suspicion, unswapped, work_done
from limber.recordings.slips import likely_slip, require_no_slip
from limber.recordings.time_series import Stream, read_stream, write_stream


@pytest.fixture
def tables(tmp_path, plain_pull):
    """The hand-made spring as robot.csv and markers.csv."""
    write_pull(tmp_path / "made", plain_pull)
    for name in ("robot.csv", "markers.csv"):
        (tmp_path / name).write_bytes((tmp_path / "made" / name).read_bytes())
    return tmp_path


def rewritten(path, change):
    """Apply ``change`` to the lines of a table."""
    lines = path.read_text().splitlines()
    path.write_text("\n".join(change(lines)) + "\n")


def changed(path, change):
    """Apply ``change`` to times and values of a table."""
    stream = read_stream(path)
    times, values = change(stream.times.copy(), stream.values.copy())
    write_stream(path, Stream(times, values, stream.columns))


def imported(folder, tables, capsys, *options, code=0):
    """The last line of import-pull of the two tables, as ``m``."""
    assert call(["import-pull", str(folder), str(tables / "markers.csv"), "--name", "m", "--robot",
                 str(tables / "robot.csv"), "--time-offset", "0", "--force-sigma", "0.02",
                 "--json", "--progress", "none", *options]) == code
    return json.loads(capsys.readouterr().out.strip().splitlines()[-1])


def warned(line, *words):
    return any(all(word in warning for word in words) for warning in line["warnings"])


def test_a_good_recording_raises_no_word(bare_folder, tables, capsys):
    """Nothing wrong: only what was assumed is said."""
    told, = imported(bare_folder, tables, capsys)["warnings"]
    assert "calibration errors of gripper and force sensor are not stated" in told


def test_stamps_out_of_order_and_twice(bare_folder, tables, capsys):
    """Two rows exchanged and one doubled: sorted, the first kept, both told."""
    def change(lines):
        lines[20], lines[21] = lines[21], lines[20]
        return [*lines[:40], lines[39], *lines[40:]]
    rewritten(tables / "robot.csv", change)
    line = imported(bare_folder, tables, capsys)
    assert warned(line, "robot.csv", "out of order") and warned(line, "duplicate")
    assert len(read_pull(bare_folder / "pulls" / "m").times) == 201


def test_a_clock_that_runs_backwards_is_refused(bare_folder, tables, capsys):
    """A tenth of the stamps backwards is no clock: exit 2, and no pull is left behind."""
    rng = np.random.default_rng(0)
    rewritten(tables / "markers.csv", lambda lines: [
        lines[0], *rng.permutation(lines[1:]).tolist()])
    line = imported(bare_folder, tables, capsys, code=2)
    assert "run backwards" in line["error"]
    assert not (bare_folder / "pulls" / "m").exists()


def test_a_gap(bare_folder, tables, capsys):
    """A second without robot: its length is told."""
    def change(times, values):
        keep = (times < 1.5) | (times > 2.5)
        return times[keep], values[keep]
    changed(tables / "robot.csv", change)
    assert warned(imported(bare_folder, tables, capsys), "gap", "1.0")


def test_spike_saturation_offset_and_sign(bare_folder, tables, capsys):
    """Each fault of a force sensor alone: named, with what was done about it."""
    good = (tables / "robot.csv").read_bytes()

    def spike(times, values):
        values[100, 8] += 6.0
        return times, values

    def flat(times, values):
        values[:, 6] = np.minimum(values[:, 6], 3.0)
        return times, values

    def untared(times, values):
        values[:, 6:9] += [0.5, 0.3, -0.4]
        return times, values

    def turned(times, values):
        values[:, 6:] *= -1
        return times, values

    for change, words in ((spike, ("spike", "discarded")), (flat, ("saturated",)),
                          (untared, ("not tared", "subtracted")), (turned, ("sign was reversed",))):
        (tables / "robot.csv").write_bytes(good)
        changed(tables / "robot.csv", change)
        line = imported(bare_folder, tables, capsys)
        assert warned(line, *words), (change.__name__, line["warnings"])


def test_markers_that_swap(bare_folder, tables, capsys):
    """Two markers exchange names at frame 30: told, and put right when the pull is used."""
    def change(times, values):
        values[30:] = values[30:, [3, 4, 5, 0, 1, 2]]
        return times, values
    changed(tables / "markers.csv", change)
    assert warned(imported(bare_folder, tables, capsys), "swapped", "30")


@pytest.mark.parametrize("table", ["robot.csv", "markers.csv"])
def test_a_recording_that_ends_inside_a_line(bare_folder, tables, capsys, table):
    """The power went off: the cut line is dropped with a word."""
    path = tables / table
    path.write_text(path.read_text()[:-25])
    assert warned(imported(bare_folder, tables, capsys), table, "incomplete")


def test_clocks_without_a_common_moment(bare_folder, tables, capsys):
    """One clock counts from 1970, the other from its start: taken to start together, and told."""
    changed(tables / "markers.csv", lambda times, values: (times - times[0] + 1.7e9, values))
    assert call(["import-pull", str(bare_folder), str(tables / "markers.csv"), "--name", "m",
                 "--robot", str(tables / "robot.csv"), "--json", "--progress", "none"]) == 0
    line = json.loads(capsys.readouterr().out.strip().splitlines()[-1])
    assert warned(line, "do not overlap")
    assert line["time_offset_s"] == pytest.approx(0.2 - 1.7e9, abs=0.2)


def pull_with(bare_folder, name, change):
    """A copy of the virtual pull with a changed robot or marker table, imported as ``name``."""
    source = bare_folder.parent / f"{name}-source"
    source.mkdir()
    for file in (bare_folder / "pulls" / "pull-1").iterdir():
        (source / file.name).write_bytes(file.read_bytes())
    change(source)
    assert call(["import-pull", str(bare_folder), str(source), "--name", name,
                 "--progress", "none"]) == 0


def estimated(branch_folder, capsys, *options, code=0):
    capsys.readouterr()
    assert call(["estimate", str(branch_folder), "--quick", "--fractions", "0.6",
                 "--field", "inverse_distance", "--json", "--progress", "none", *options]) == code
    return json.loads(capsys.readouterr().out.strip().splitlines()[-1])


@pytest.mark.slow
def test_a_pull_of_another_branch(branch_folder, capsys):
    """Markers 3 cm from where this branch has them, moving otherwise: the rest, then the loss say
    so, and nothing is written.
    """
    def change(source):
        def stretched(times, values):
            points = values.reshape(len(values), -1, 3)
            points = points * [1.0, 0.3, 1.0] + [0.0, 0.03, 0.0]
            return times, points.reshape(values.shape)
        changed(source / "markers.csv", stretched)
    pull_with(branch_folder, "stranger", change)
    before = (branch_folder / "mesh.vtu").read_bytes()
    line = estimated(branch_folder, capsys, "--pull", "stranger", code=3)
    assert warned(line, "at rest", "another branch") and warned(line, "fit is poor")
    assert "does not move as the observed one" in line["error"]
    assert (branch_folder / "mesh.vtu").read_bytes() == before


@pytest.mark.slow
def test_force_in_another_unit_and_a_modulus_at_its_bound(branch_folder, capsys):
    """Kilonewtons taken for newtons: the unit is named; what asks for less than the least modulus
    is no result.
    """
    def change(source):
        changed(source / "robot.csv", lambda times, values: (
            times, np.hstack([values[:, :6], 1e-4 * values[:, 6:]])))
        text = (source / "pull.toml").read_text()
        (source / "pull.toml").write_text(re.sub("force_sigma_n.*", "force_sigma_n = 1e-6", text))
    pull_with(branch_folder, "tiny", change)
    line = estimated(branch_folder, capsys, "--pull", "tiny", code=3)
    assert warned(line, "another unit") and warned(line, "--force-unit")
    assert line["status"] == "failed" and "converged" not in line
    assert "bound" in line["error"] or "no equilibrium" in line["error"]


def test_rgbd_faults(bare_folder, tables, capsys):
    """A missing image, no intrinsics, a camera that moves, no list: each its own sentence."""
    folder = tables / "rgbd"
    (folder / "depth").mkdir(parents=True)
    camera = D455.model_copy(update={
        "width": 8, "height": 6, "cx": 3.5, "cy": 2.5, "depth_scale": 5000.0})
    rows = []
    for k in range(4):
        write_depth(folder / "depth" / f"f{k}.png", np.full((6, 8), 1.2), camera)
        rows.append(f"{0.5 * k:.3f} depth/f{k}.png")
    (folder / "depth.txt").write_text("# list\n" + "\n".join(rows) + "\n2.0")

    def run(code):
        assert call(["import-pull", str(bare_folder), str(folder), "--name", "d", "--robot",
                     str(tables / "robot.csv"), "--json", "--progress", "none"]) == code
        return json.loads(capsys.readouterr().out.strip().splitlines()[-1])

    assert "intrinsics" in run(2)["error"]
    open3d = {"width": 8, "height": 6, "intrinsic_matrix": [525.0, 0, 0, 0, 525.0, 0, 4.0, 3.0, 1]}
    for wrong in ({"width": True}, {"intrinsic_matrix": [525.0] * 3}, {"depth_scale": "much"},
                  {"intrinsic_matrix": [True] * 9}):
        (folder / "intrinsic.json").write_text(json.dumps(open3d | wrong))
        assert "Open3D" in run(2)["error"]
    (folder / "intrinsic.json").write_text(json.dumps(open3d))
    assert len(run(0)["warnings"]) == 1
    (folder / "intrinsic.json").unlink()
    (folder / "calibration.txt").write_text("525.0 525.0 3.5 2.5\n")
    assert len(run(0)["warnings"]) == 1
    (folder / "groundtruth.txt").write_text("0.0 0 0 0 0 0 0 1\n1.0 0.1 0 0 0 0 0 1\n")
    assert "camera moves" in run(2)["error"]
    (folder / "groundtruth.txt").unlink()
    (folder / "depth" / "f2.png").unlink()
    assert warned(run(0), "1 of 4 depth images are missing")
    write_camera(folder / "camera.toml", camera)
    (folder / "mask").mkdir()
    Image.fromarray(np.full((6, 8), 255, np.uint8)).save(folder / "mask" / "f0.png")
    assert warned(run(0), "2 of 3 frames have no mask")
    Image.fromarray(np.full((6, 8), 120, np.uint8)).save(folder / "depth" / "f0.png")
    assert "f0.png has 8 bits a pixel" in run(2)["error"]


def test_markers_in_another_unit_are_refused(branch_folder, capsys):
    """Millimetres taken for metres: refused at once, and the moduli in the mesh stay."""
    def change(source):
        changed(source / "markers.csv", lambda times, values: (times, 1000 * values))
    before = (branch_folder / "mesh.vtu").read_bytes()
    pull_with(branch_folder, "millimetres", change)
    line = estimated(branch_folder, capsys, "--pull", "millimetres", code=2)
    assert "another unit" in line["error"] and "--unit" in line["error"]
    assert (branch_folder / "mesh.vtu").read_bytes() == before


@pytest.mark.parametrize(("table", "column", "value", "told"), [
    ("robot.csv", 2, np.nan, "no row with a complete pose"),
    ("robot.csv", 0, 1e308, "gripper's position reaches"),
    ("robot.csv", 6, 1e200, "force reaches 1e+200 N"), ("robot.csv", 9, -1e30, "torque reaches"),
    ("markers.csv", 1, 1e308, "marker's position reaches"),
    ("markers.csv", 1, 1e200, "marker's position reaches 1e+200 m")])
def test_impossible_columns_are_refused(bare_folder, tables, capsys, table, column, value, told):
    """A column without a number, and numbers that no square can be taken of."""
    def change(times, values):
        values[:, column] = value
        return times, values
    changed(tables / table, change)
    line = imported(bare_folder, tables, capsys, "--grasp-point", "0", "0", "0.2", code=2)
    assert told in line["error"], line["error"]


def test_a_recording_of_the_gripper_alone_is_no_estimate(branch_folder, capsys):
    """Nothing was seen of the branch: one sentence says so."""
    def change(source):
        entry = (source / "pull.toml").read_text()
        (source / "pull.toml").write_text("\n".join(
            'observation = "none"' if row.startswith("observation") else row
            for row in entry.splitlines()) + "\n")
    pull_with(branch_folder, "alone", change)
    line = estimated(branch_folder, capsys, "--pull", "alone", code=2)
    assert "alone has nothing that was seen of the branch" in line["error"]


# Hand-made tables with a slip: it is named when they are imported.


@pytest.mark.parametrize(("change", "told"), [
    (lambda p: {"times": 1e3 * p.times, "observations": None}, "longer than an hour.*t_ms"),
    (lambda p: {"wrenches": np.zeros_like(p.wrenches)}, "zero in all.*remove the columns")])
def test_what_no_robot_does_is_refused(plain_pull, change, told):
    """Physical limits: 5 m/s, a turn, an hour; two tables of one pull last about as long."""
    assert require_no_slip(plain_pull) == plain_pull
    if "hour" in told:
        plain_pull = replace(plain_pull, times=3.0 * plain_pull.times)
    with pytest.raises(InputError, match=told):
        require_no_slip(replace(plain_pull, **change(plain_pull)))


def test_a_pull_without_force_is_named(plain_pull):
    found = require_no_slip(replace(plain_pull, wrenches=np.full_like(plain_pull.wrenches, np.nan)))
    assert "has no force" in found.warnings[-1]


@pytest.mark.parametrize(("change", "told"), [
    (lambda p: 1e3 * p, "millimetres"), (lambda p: p[:, [2, 1, 0]], "likely z, y, x"),
    (lambda p: p[:, [1, 2, 0]], "likely y, z, x"), (lambda p: p - [0.5, 0, 0.2], "of the scan"),
    (lambda p: (p + [-0.5, 0, -0.2])[:, [1, 2, 0]] - [-0.5, 0, -0.2], "likely y, z, x"),
    (lambda p: p + 3.0, "")])
def test_the_slip_that_puts_points_on_the_branch(change, told):
    """Millimetres, exchanged titles, the scan's frame; none where none fits."""
    nodes = np.linspace([0.0, 0.1, 0.0], [0.05, 0.1, 0.8], 200)
    points = nodes[[50, 120, 190]]
    found = likely_slip(change(points), nodes, Alignment(origin=(-0.5, 0.0, -0.2)), 0.02)
    assert (told in found) if told else not found


# Faults of sensors and markers are found, repaired and told.


def with_force(pull, wrenches):
    return replace(pull, wrenches=wrenches)


def test_a_good_pull_is_left_alone(plain_pull):
    """No fault, no word, no change."""
    cleaned = clean(plain_pull)
    assert not cleaned.warnings
    assert np.array_equal(cleaned.wrenches, plain_pull.wrenches)
    assert np.array_equal(cleaned.observations.positions, plain_pull.observations.positions)


def test_work_equals_the_energy_of_the_spring(plain_pull):
    """50 N/m pulled out by 0.1 m stores 0.25 J."""
    assert work_done(plain_pull)[-1] == pytest.approx(0.25, rel=0.01)


def test_wrong_sign_is_turned(plain_pull):
    """A sensor that reports the branch's force on the gripper: negative work gives it away."""
    cleaned = clean(with_force(plain_pull, -plain_pull.wrenches))
    assert np.allclose(cleaned.wrenches, plain_pull.wrenches)
    assert any("sign was reversed" in w for w in cleaned.warnings)


def test_a_noisy_first_reading_is_no_sign(plain_pull):
    """All others are then below it, as if a small force pulled back all the way."""
    way = plain_pull.poses[-1, :3] - plain_pull.poses[0, :3]
    wrenches = np.zeros_like(plain_pull.wrenches)
    wrenches[0, :3] = 2 * plain_pull.entry.sensor.force_sigma_n * way / np.linalg.norm(way)
    assert not clean(with_force(plain_pull, wrenches)).warnings


def test_sign_is_only_questioned_under_gravity(plain_pull):
    """A heavy branch that is lowered does work on the gripper: then the sign stays."""
    entry = plain_pull.entry.model_copy(update={"gravity_m_s2": (0.0, 0.0, -9.81)})
    pull = replace(plain_pull, entry=entry, wrenches=-plain_pull.wrenches)
    cleaned = clean(pull)
    assert np.array_equal(cleaned.wrenches, pull.wrenches)
    assert any("weight" in w for w in cleaned.warnings)


def test_untared_sensor(plain_pull):
    """The reading at rest is subtracted."""
    bias = np.r_[0.4, -0.3, 0.2, 0.01, 0.0, 0.0]
    cleaned = clean(with_force(plain_pull, plain_pull.wrenches + bias))
    assert np.abs(np.mean(cleaned.wrenches - plain_pull.wrenches, axis=0)).max() < 0.02
    assert any("not tared" in w for w in cleaned.warnings)


def test_saturation_and_spikes_are_left_out(plain_pull):
    """Readings at the limit and single jumps become "not measured"; the rest stays."""
    wrenches = plain_pull.wrenches.copy()
    wrenches[:, 0] = np.minimum(wrenches[:, 0], 3.0)
    wrenches[60, 2] += 5.0
    cleaned = clean(with_force(plain_pull, wrenches))
    lost = ~np.isfinite(cleaned.wrenches[:, 0])
    assert lost[60] and lost[wrenches[:, 0] == 3.0].all()
    assert lost.sum() == 1 + np.sum(wrenches[:, 0] == 3.0)
    text = " ".join(cleaned.warnings)
    assert "saturated" in text and "spike" in text


def test_known_range_of_the_sensor(plain_pull):
    """Readings at the range that pull.toml states count as saturated without a flat top."""
    sensor = plain_pull.entry.sensor.model_copy(update={"force_range_n": 4.0})
    pull = replace(plain_pull, entry=plain_pull.entry.model_copy(update={"sensor": sensor}))
    cleaned = clean(pull)
    beyond = np.abs(plain_pull.wrenches[:, 0]) >= 4.0
    assert beyond.any() and np.array_equal(~np.isfinite(cleaned.wrenches[:, 0]), beyond)


def test_swapped_markers_get_their_names_back(plain_pull):
    """Two markers that exchange names for a while: positions come out as if they had not."""
    positions = plain_pull.observations.positions.copy()
    positions[20:35] = positions[20:35, ::-1]
    fixed, frames = unswapped(Observations(plain_pull.observations.times, positions))
    assert np.allclose(fixed.positions, plain_pull.observations.positions)
    assert frames == [20, 35]
    told = clean(replace(plain_pull, observations=Observations(
        plain_pull.observations.times, positions))).warnings
    assert any("swapped" in w for w in told)


def test_a_lost_marker_is_not_a_swap(plain_pull):
    """A marker that vanishes for some frames keeps its name, and so do the others."""
    positions = plain_pull.observations.positions.copy()
    positions[10:20, 0] = np.nan
    fixed, frames = unswapped(Observations(plain_pull.observations.times, positions))
    assert not frames and np.allclose(fixed.positions, positions, equal_nan=True)


def test_gap_is_told(plain_pull):
    """A second without robot data is named."""
    keep = (plain_pull.times < 1.0) | (plain_pull.times > 2.0)
    pull = replace(plain_pull, times=plain_pull.times[keep], poses=plain_pull.poses[keep],
                   wrenches=plain_pull.wrenches[keep])
    assert any("gap" in w and "1.0" in w for w in clean(pull).warnings)


@pytest.mark.parametrize(("unit", "young"), [
    ("gf", 1e9), ("mN", 1e9), ("kgf", 1e5), ("lbf", 5e4), ("kN", 1e6)])
def test_an_impossible_modulus_names_the_unit(unit, young):
    """Forces in another unit than newtons scale the modulus; where that shows, the unit is named.
    """
    assert unit in force_unit_suspicion(young / FORCE_UNITS_N[unit])


def test_plausible_moduli_raise_no_suspicion():
    """Silicone, a green twig and dry oak are all possible."""
    assert all(force_unit_suspicion(young) is None for young in (2.5e5, 3e8, 1.2e10))


def test_tables_in_the_scans_coordinates_need_one_option(bare_folder, tables, capsys):
    """Positions, rotations and forces turn and move as the scan does; a gauge has no torque."""
    turn = ((0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    manifest = json.loads((bare_folder / "branch.json").read_text())
    manifest["alignment"] = {"scale": 1.0, "origin": (5.0, 2.0, 1.0), "rotation": turn}
    (bare_folder / "branch.json").write_text(json.dumps(manifest))
    before = read_pull(tables / "made")
    robot = read_stream(tables / "robot.csv")
    values = robot.values.copy()
    for k in range(0, 12, 3):
        values[:, k:k + 3] = values[:, k:k + 3] @ np.array(turn)
    values[:, :3] += [5.0, 2.0, 1.0]
    write_stream(tables / "robot.csv", Stream(robot.times, values[:, :9], robot.columns[:9]))
    changed(tables / "markers.csv", lambda times, values: (times, (
        values.reshape(-1, 3) @ np.array(turn) + [5.0, 2.0, 1.0]).reshape(values.shape)))
    imported(bare_folder, tables, capsys, "--coordinates", "scan")
    after = read_pull(bare_folder / "pulls" / "m")
    for own, made in ((after.poses[:, :3], before.poses[:, :3]),
                      (after.wrenches[:, :3], before.wrenches[:, :3]),
                      (after.observations.positions, before.observations.positions)):
        np.testing.assert_allclose(own, made, atol=1e-6)


def test_a_small_force_names_the_errors_to_state(bare_folder, tables, capsys):
    changed(tables / "robot.csv", lambda times, values: (
        times, np.hstack([values[:, :6], 0.05 * values[:, 6:]])))
    assert warned(imported(bare_folder, tables, capsys), "force zero 1 N", "is small against them",
                  "--force-sigma", "force_bias_sigma_n")


def test_points_beside_a_branch_are_not_said_to_be_millimetres():
    """Whatever is a metre away fits near the base once divided by a thousand."""
    nodes = np.column_stack([np.zeros(50), np.zeros(50), np.linspace(0, 0.4, 50)])
    assert "millimetres" not in likely_slip(np.array([[0.3, 0.0, 0.2]]), nodes, Alignment(), 0.1)
    assert "millimetres" in likely_slip(np.array([[10.0, 0.0, 300.0]]), nodes, Alignment(), 0.1)


def test_a_point_of_another_branch_is_not_said_to_have_other_axes():
    """Of 47 turns some bring it near."""
    nodes = np.linspace([0.0, 0.1, 0.0], [0.05, 0.1, 0.8], 200)
    assert not likely_slip(np.array([[0.3, 0.2, 0.1]]), nodes, Alignment(), 0.25)
