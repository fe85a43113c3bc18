"""What a user states of section and sensor, by the commands: estimates of pulls with a truth.

The truth is a rod, which shares no code with the fit; its section is that of the closed formula.
"""

import json
from dataclasses import dataclass, replace

import numpy as np
import pytest

from limber.cli.main import call
from limber.estimation.settings import PullSpec
from limber.estimation.simulated_pull import TrueBranch, simulate_pull
from limber.recordings.recording import write_pull

YOUNG = 3e7
PITH, BARK, BARK_SHARE = 5e-3, 1.2e-3, 0.2
OFFSET_N = np.array([-6.0, 4.0, 5.0])


@dataclass(frozen=True)
class LayeredBranch(TrueBranch):
    """Wood of one modulus, with a hollow and bark; the rod takes the equivalent modulus."""

    layers: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def second_moment(self, radius):
        """Of the wood, plus that of the bark by its share of the wood's modulus [m^4]."""
        pith, bark, share = self.layers
        wood = radius - bark
        return np.pi / 4 * (wood**4 - pith**4 + share * (radius**4 - wood**4))

    def young_at(self, positions):
        path = self.skeleton.main_path()
        nearest = np.argmin(np.linalg.norm(
            positions[:, None] - self.skeleton.nodes[path], axis=2), axis=1)
        radius = self.skeleton.radius[path][nearest]
        return YOUNG * self.second_moment(radius) / (np.pi / 4 * radius**4)


def recorded(folder, truth, first=0, offset=0.0):
    """Write a pull of the truth as tables of a robot and of markers; returns the pull."""
    settings = PullSpec(model="rod", frames=40, seed=5, phase=0.7, poisson=0.36,
                        position_noise=3e-4, force_noise=5e-3)
    pull = simulate_pull(truth, "pull-2", settings)[0]
    wrenches = pull.wrenches + np.r_[offset + np.zeros(3), np.zeros(3)]
    seen = pull.observations
    pull = replace(pull, times=pull.times[first:], poses=pull.poses[first:],
                   wrenches=wrenches[first:], observations=replace(
                       seen, times=seen.times[first:], positions=seen.positions[first:]))
    write_pull(folder, pull)
    return pull


def estimated(folder, branch, pull, capsys, *options, sensor=""):
    """The result of import-pull and estimate, or None if they refuse."""
    entry, stated = pull.entry, folder / "cell.toml"
    stated.write_text("[calibration]\npose_sigma_m = 2e-4\npose_sigma_rad = 3.5e-3\n"
                      f"force_bias_sigma_n = 0.02\nforce_drift_sigma_n = 0.02\n"
                      f"[sensor]\nposition_sigma_m = {entry.sensor.position_sigma_m}\n{sensor}")
    assert call(["import-pull", str(branch), str(folder / "markers.csv"), "--name", "pull-2",
                 "--robot", str(folder / "robot.csv"), "--time-offset", "0",
                 "--grasp-point", *map(str, entry.grasp.point_m),
                 "--grasp-radius", str(entry.grasp.radius_m), "--grasp-mode", "point",
                 "--force-sigma", str(entry.sensor.force_sigma_n),
                 "--pull-toml", str(stated), "--progress", "none"]) == 0
    capsys.readouterr()
    code = call(["estimate", str(branch), "--pull", "pull-2", "--fractions", "0.2,0.4,0.6,0.8",
                 "--json", "--progress", "none", *options])
    told = capsys.readouterr()
    assert code in (0, 3), told.err
    return json.loads(told.out.strip().splitlines()[-1]) if code == 0 else None


def holds(interval, truth):
    low, high = np.array(interval, float).T
    return (low < truth) & (truth < high)


@pytest.fixture
def branch_of(small):
    return lambda layers: LayeredBranch(**vars(small.truth()), layers=layers)


@pytest.mark.slow
@pytest.mark.parametrize(("layers", "options"), [
    ((PITH, 0.0, 0.0), ("--pith-radius", str(PITH))),
    ((0.0, BARK, BARK_SHARE), ("--bark", str(BARK), str(BARK_SHARE)))])
def test_stated_layers_give_the_modulus_of_the_wood(branch_of, branch_folder, tmp_path, capsys,
                                                    layers, options):
    """Stated or not, E I is the same and right; stated, E is that of the wood as well."""
    truth = branch_of(layers)
    pull = recorded(tmp_path, truth)
    stated = estimated(tmp_path, branch_folder, pull, capsys, *options)
    share = np.array(json.loads((branch_folder / "estimate.json").read_text())[
        "bending_stiffness_share"])
    radius = truth.skeleton.radius[truth.skeleton.main_path()]
    bending = YOUNG * np.exp(share @ np.log(truth.second_moment(radius)))
    assert holds(stated["young_interval_pa"], YOUNG).all()
    assert holds(stated["bending_stiffness_interval_nm2"], bending).all()
    assert np.array(stated["young_pa"]) == pytest.approx(YOUNG, rel=0.2)
    assert np.array(stated["bending_stiffness_nm2"]) == pytest.approx(bending, rel=0.2)
    solid = estimated(tmp_path, branch_folder, pull, capsys, "--quick")
    factor = np.array(solid["young_pa"]) / np.array(stated["young_pa"])
    assert factor == pytest.approx(np.exp(share @ np.log(truth.second_moment(radius) / (
        np.pi / 4 * radius**4))), rel=0.1)
    assert np.array(solid["bending_stiffness_nm2"]) == pytest.approx(
        stated["bending_stiffness_nm2"], rel=0.1)


@pytest.mark.slow
def test_a_stated_missing_tare_is_fitted(branch_of, branch_folder, tmp_path, capsys):
    """The recording begins when the branch is bent, so that no reading at rest shows the zero.

    Not stated, a zero many times the stated one gives no interval that excludes the truth.
    """
    pull = recorded(tmp_path, branch_of((0.0, 0.0, 0.0)), first=8, offset=OFFSET_N)
    found = estimated(tmp_path, branch_folder, pull, capsys, sensor="tared = false\n")
    assert holds(found["young_interval_pa"], YOUNG).all()
    zeros = [each for each in found["cell_errors"] if each["name"].startswith("force zero")]
    assert holds([each["interval"] for each in zeros], OFFSET_N).all()
    assert np.array([each["value"] for each in zeros]) == pytest.approx(OFFSET_N, abs=0.5)
    unstated = estimated(tmp_path, branch_folder, pull, capsys)
    assert unstated is None or holds(unstated["young_interval_pa"], YOUNG).all()
