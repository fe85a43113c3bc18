"""Frequencies and damping of records whose vibrations are known."""

import numpy as np
import pytest

from limber.core.errors import InputError
from limber.estimation.vibration.ringing import identify


def record(rng, *, frequencies=(2.3, 7.9), damping=(0.02, 0.03), size=(1.0, 0.4), noise=0.05,
           seconds=12.0, rate=120.0, channels=2):
    """A pluck after a second of rest, with drift, in a few channels."""
    times = np.arange(0.0, seconds, 1 / rate)
    since = np.maximum(times - 1.0, 0.0)
    found = np.zeros((len(times), channels))
    for frequency, ratio, amplitude in zip(frequencies, damping, size, strict=True):
        omega = 2 * np.pi * frequency
        way = np.exp(-ratio * omega * since) * np.cos(omega * np.sqrt(1 - ratio**2) * since)
        found += amplitude * np.where(since > 0, way, 0.0)[:, None] * (
            1 - 0.5 * np.arange(channels))
    return times, found + noise * rng.standard_normal(found.shape)


@pytest.mark.slow
def test_two_vibrations_with_their_deviations():
    """Of 40 noisy records the first frequency lies within two deviations in about 95 %."""
    rng, inside = np.random.default_rng(8), 0
    for _ in range(40):
        found = identify(*record(rng))
        assert found.frequencies[0] == pytest.approx(2.3, rel=5e-3)
        assert found.damping[0] == pytest.approx(0.02, rel=0.3)
        inside += abs(found.frequencies[0] - 2.3) < 1.96 * found.frequency_deviations[0]
    assert 34 <= inside <= 40
    assert found.frequencies[1] == pytest.approx(7.9, rel=1e-2) and found.left_over < 0.5


def test_close_vibrations_are_parted_by_a_long_record():
    found = identify(*record(np.random.default_rng(1), frequencies=(2.3, 2.5), damping=(0.01, 0.01),
                             size=(1.0, 0.8), seconds=30.0, noise=0.02))
    np.testing.assert_allclose(found.frequencies[:2], [2.3, 2.5], rtol=3e-3)


@pytest.mark.parametrize(("change", "told"), [
    ({"size": (0.0, 0.0), "noise": 1.0}, "no free vibration"),
    ({"seconds": 1.1}, "free decay"),
    ({"frequencies": (0.15, 0.15), "seconds": 9.0}, "several oscillations"),
])
def test_what_does_not_ring_is_told(change, told):
    times, channels = record(np.random.default_rng(3), **change)
    with pytest.raises(InputError, match=told):
        identify(times, channels, start=1.0)
