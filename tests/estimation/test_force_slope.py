"""Force against displacement."""

from pathlib import Path

import numpy as np
import pytest

from limber.errors import InputError
from limber.estimation.force_slope import force_slope, read_force_displacement

DATA = Path(__file__).parents[3] / "shared" / "data" / "blueberry_cane_push"


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
    way, force, _ = read_force_displacement(path)
    assert force[1] == pytest.approx(0.980665) and way[1] == pytest.approx(1e-3)
    path.write_text("force,displacement_mm\n" + rows)
    with pytest.raises(InputError, match="unit"):
        read_force_displacement(path)


def test_incomplete_rows_are_dropped_with_a_word(tmp_path):
    """A recording that ends in the middle of a line gives its slope nevertheless."""
    rows = "".join(f"{0.1 * k},{k}\n" for k in range(8))
    path = tmp_path / "a.csv"
    path.write_text("force (N),displacement (mm)\n" + rows + "0.9")
    way, _, warnings = read_force_displacement(path)
    assert len(way) == 8 and "unfinished" in warnings[0]


@pytest.mark.skipif(not DATA.is_dir(), reason="the recorded cane pushes are not here")
def test_recorded_canes():
    """27 pushes of living canes: each has a positive slope within its interval, near that of a
    plain line through what lies over the noise.
    """
    files = sorted(DATA.glob("*.csv"))
    assert len(files) == 27
    off = []
    for path in files:
        way, force, warnings = read_force_displacement(path)
        found = force_slope(way, force, warnings=warnings)
        over = force > 20 * 9.80665e-3
        plain = np.polyfit(way[over], force[over], 1)[0]
        assert 10 < found.interval[0] < found.slope < found.interval[1] < 2000
        off.append(abs(found.slope / plain - 1))
    assert np.median(off) < 0.03 and max(off) < 0.25
