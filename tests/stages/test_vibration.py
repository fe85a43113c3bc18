"""`limber vibration` on the example branch: the modulus comes back from what it would ring like."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from limber.cli.main import call
from limber.core.errors import InputError
from limber.core.json_values import stored
from limber.mechanics.dynamics.motion import lowest_modes
from limber.stages.moduli.vibration import FitVibration
from limber.stages.registry import result_of
from limber.store import Branch
from limber.store.loading import load_branch, load_mesh

EXAMPLE = Path(__file__).parents[2] / "blend_files" / "bending_branch"


@pytest.fixture
def branch(tmp_path) -> Branch:
    return Branch.open(Path(shutil.copytree(EXAMPLE, tmp_path / "a.branch")))


def written(path: Path, frequency: float, damping: float = 0.03) -> Path:
    times = np.arange(0.0, 10.0, 0.01)
    omega = 2 * np.pi * frequency
    way = 9.81 * np.exp(-damping * omega * times) * np.cos(omega * np.sqrt(1 - damping**2) * times)
    way += 0.05 * np.random.default_rng(2).standard_normal(len(times))
    path.write_text("time_s,a_x\n" + "".join(f"{t:.3f},{a:.5f}\n" for t, a in
                                             zip(times, way, strict=True)))
    return path


@pytest.mark.slow
def test_a_stiffer_branch_rings_faster(branch, tmp_path):
    """A record of the branch with 1.5 times its modulus gives that factor, and keeps it."""
    model = load_branch(branch).model
    before = float(load_mesh(branch).cell_data["young"].mean())
    wanted = float(lowest_modes(model.with_young(1.5 * model.young), 1).frequencies[0])
    record = written(tmp_path / "ring.csv", wanted)
    told = FitVibration(branch_folder=branch.folder, record=record).run()
    assert told["young_factor"] == pytest.approx(1.5, rel=0.01)
    low, high = told["young_interval_pa"]
    assert low < told["young_pa"] < high
    assert told["young_pa"] == pytest.approx(1.5 * before, rel=0.01)
    assert told["damping_ratios"][0] == pytest.approx(0.03, rel=0.05)
    now = Branch.open(branch.folder, verify=True)
    assert load_mesh(now).cell_data["young"].mean() == pytest.approx(told["young_pa"])
    # A mesh of before digits were rounded is another once it is rewritten.
    again = FitVibration(branch_folder=branch.folder, record=record)
    assert stored(again.run()) == again.run(), "kept"
    section = result_of(now, "vibration", told).section(now, "vibration")
    (_, modulus), (_, vibrations) = section.tables
    assert modulus[1][1] == f"{told['young_pa'] / 1e6:.4g}" and len(vibrations) == 1 + len(
        told["frequencies_hz"])
    with pytest.raises(InputError, match=r"branch\.json: young_interval"):
        result_of(now, "vibration", told | {"young_interval_pa": [1.0]})


@pytest.mark.slow
def test_import_pull_takes_a_record_of_a_swing(branch, tmp_path, capsys):
    """Other names and units of time, a counter and a gap beside the readings: the same modulus."""
    record = written(tmp_path / "ring.csv", 2.5)
    plain = FitVibration(branch_folder=branch.folder, record=record).run()
    rows = [line.split(",") for line in record.read_text().splitlines()[1:]]
    (tmp_path / "strain.csv").write_text("Frame;Time (ms);strain (um/m);tip_x_m\n" + "".join(
        f"{number};{1e3 * float(time):.3f};{reading};{'' if number == 7 else reading}\n"
        for number, (time, reading) in enumerate(rows)))
    assert call(["import-pull", str(branch.folder), str(tmp_path / "strain.csv"), "--name", "s",
                 "--motion", "swing", "--json"]) == 0
    told = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert told["kind"] == "ringing"
    assert told["frequencies_hz"][0] == pytest.approx(2.5, rel=1e-3)
    assert told["young_pa"] == pytest.approx(plain["young_pa"], rel=1e-3)


@pytest.mark.slow
def test_a_heavy_sensor_is_reckoned_with(branch, tmp_path):
    """The same record with a mass at the tip means stiffer wood."""
    tip = load_mesh(branch).nodes[load_mesh(branch).nodes[:, 2].argmax()]
    record = written(tmp_path / "ring.csv", 2.5)
    plain = FitVibration(branch_folder=branch.folder, record=record).run()["young_pa"]
    heavy = FitVibration(branch_folder=branch.folder, record=record,
                         sensor=(*tip, 0.005)).run()["young_pa"]
    assert heavy > 1.1 * plain


@pytest.mark.parametrize(("content", "told"), [
    ("time_s\n0\n1\n", "no row of numbers"),
    ("time_s,a\n1,1\n0,2\n", "backwards"),
    ("time_s,a\n0,nan\n1,2\n", "two samples"),
    ("t,a\n1,1\n", "two samples"),
    ("b,a\n1,1\n", "No column is named time"),
    ("time_s,a\n" + "".join(f"{k},1\n" for k in range(40)) + "1e12,1\n", "gaps"),
    ("time_s,a\n" + "".join(f"{k / 50},{k % 7}\n" for k in range(40)) + "3600,1\n", "gaps"),
    ("time,a\n" + "".join(f"{k / 2},{np.exp(-k / 90) * np.cos(k / 22):.5f}\n"
                          for k in range(600)), "another unit"),
    ("time_s,a,b\n" + "".join(f"{k / 50},3,{k}\n" for k in range(90)), "changes"),
    ("time_s,a\n" + "".join(f"{k},{k % 2}\n" for k in range(9)), "At least 32"),
])
def test_a_record_that_cannot_be_used(branch, tmp_path, content, told):
    path = tmp_path / "ring.csv"
    path.write_text(content)
    before = (branch.folder / "branch.json").read_bytes()
    with pytest.raises(InputError, match=told):
        FitVibration(branch_folder=branch.folder, record=path).run()
    assert (branch.folder / "branch.json").read_bytes() == before
