"""Faults of sensors and markers are found, repaired and told."""

from dataclasses import replace

import numpy as np
import pytest

from limber.core.constants import FORCE_UNITS_N
from limber.recordings.recording import Observations
from limber.recordings.sensor_checks import clean, force_unit_suspicion, unswapped, work_done


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
