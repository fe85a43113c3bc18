"""Gusts: spectrum, resonance and peak against closed forms and a long simulated wind."""

import numpy as np
import pytest
from scipy.integrate import trapezoid

from limber.core.errors import InputError
from limber.mechanics.loads.load_effects import WindRecord
from limber.mechanics.loads.outdoor import Swaying, recorded, turbulent, wind_spectrum

LENGTH, SPEED = 27.0, 8.0


def one_mode(frequency=0.7, damping=0.01) -> Swaying:
    return Swaying(np.array([frequency]), np.array([damping]), np.array([1.0]))


def test_the_spectrum_holds_the_variance():
    at = np.concatenate([[0.0], np.geomspace(1e-7, 1e5, 200_000)])
    assert trapezoid(wind_spectrum(at, SPEED, LENGTH), at) == pytest.approx(1.0, rel=1e-3)


def test_resonance_is_that_of_a_lightly_damped_oscillator():
    """R^2 = pi^2 S_L / (2 delta), EN 1991-1-4 B.6 without admittance, delta = 2 pi zeta."""
    sway = one_mode()
    found = turbulent(sway, SPEED, 0.2, LENGTH, 600.0)
    density = float(wind_spectrum(sway.frequencies, SPEED, LENGTH)[0])
    expected = np.pi / (4 * sway.damping[0]) * sway.frequencies[0] * density
    assert found.dynamic**2 - 1 == pytest.approx(expected, rel=0.05)
    rate = np.sqrt(2 * np.log(600 * found.crossing))
    assert found.peak_factor == pytest.approx(rate + 0.6 / rate)
    assert found.factor == pytest.approx(1 + found.peak_factor * 2 * 0.2 * found.dynamic)


def test_a_stiff_branch_follows_the_gusts():
    found = turbulent(one_mode(200.0, 0.05), SPEED, 0.1, LENGTH, 600.0)
    assert found.dynamic == pytest.approx(1.0, abs=0.02)


def test_a_recorded_wind_of_that_spectrum_gives_the_same_deviation():
    """An hour of it, made of waves of random phase; weak, so that its square is about linear."""
    rng = np.random.default_rng(5)
    step, seconds, intensity = 0.05, 3600.0, 0.02
    times = np.arange(0.0, seconds, step)
    at = np.fft.rfftfreq(len(times), step)
    size = np.sqrt(wind_spectrum(at, SPEED, LENGTH) / (2 * seconds)) * len(times)
    waves = size * np.exp(2j * np.pi * rng.random(len(at)))
    waves[0] = 0.0
    speeds = SPEED * (1 + intensity * np.fft.irfft(waves, len(times)))
    sway = one_mode(damping=0.02)
    found = recorded(sway, times, speeds)
    expected = turbulent(sway, SPEED, intensity, LENGTH, seconds)
    assert found.deviation == pytest.approx(expected.deviation, rel=0.1)
    assert found.peak_factor == pytest.approx(expected.peak_factor, rel=0.25)


def test_a_slow_gust_pushes_with_the_square_of_its_speed():
    times = np.arange(0.0, 400.0, 0.5)
    speeds = 5.0 + 1.0 * np.sin(2 * np.pi * times / 100)
    found = recorded(one_mode(20.0, 0.05), times, speeds)
    assert found.factor == pytest.approx(36.0 / np.mean(speeds**2), rel=0.01)


@pytest.mark.parametrize(("step", "factor"), [(1e-300, 1.0), (0.1, 1e-200), (0.0, 1.0)])
def test_what_no_wind_is_makes_no_record(step, factor):
    """Its steps or its speeds would leave no finite number."""
    times, speeds = step * np.arange(20), factor * (3.0 + np.cos(np.arange(20)))
    with pytest.raises(InputError, match="not a wind record"):
        WindRecord.checked(times, speeds, "this")
    WindRecord.checked(0.1 * np.arange(20), speeds / factor, "this")
