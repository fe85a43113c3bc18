"""Frequencies and damping of records whose vibrations are known."""

from pathlib import Path

import numpy as np
import pytest

from limber.core.errors import InputError
from limber.estimation.vibration.ringing import identify, read_record, ringing_columns
from limber.recordings.time_series import Stream


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


def test_a_reading_that_no_sensor_gives_is_refused():
    """Its square overflowed, and a fit of the drift failed."""
    times, values = record(np.random.default_rng(1))
    values[7, 0] = 1e300
    with pytest.raises(InputError, match="No sensor gives such a number"):
        ringing_columns(Stream(times, values, ("a", "b")))


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


def decays(rng, *, starts=(1.0, 5.0, 9.0), frequency=5.0, ratio=0.03, sizes=None, noise=0.01,
           seconds=14.0, rate=200.0, limit=None, offset=0.0):
    """A branch that is plucked again and again; each pluck takes it over from what still rings."""
    times = np.arange(0.0, seconds, 1 / rate)
    omega, found = 2 * np.pi * frequency, np.zeros(len(times))
    for start, size in zip(starts, sizes or [1.0] * len(starts), strict=True):
        since = times - start
        found = np.where(since >= 0, size * np.exp(-ratio * omega * since) * np.cos(
            omega * np.sqrt(1 - ratio**2) * since), found)
    found = offset + found + noise * rng.standard_normal(len(times))
    return times, (found if limit is None else np.clip(found, -limit, limit))[:, None]


@pytest.mark.parametrize(("change", "count"), [
    ({}, 3), ({"starts": (0.5, 7.0)}, 2), ({"starts": (0.0, 7.0)}, 2),
    ({"sizes": (1.0, 0.5, 0.8), "offset": 40.0}, 3), ({"starts": (2.0,)}, 1),
    ({"starts": (1.0, 4.0, 7.0, 10.0), "frequency": 21.7, "ratio": 0.1, "rate": 533.0}, 4),
    ({"starts": (1.0, 4.0, 7.0), "frequency": 2.0, "ratio": 0.08}, 3)])
def test_each_of_several_plucks_is_used(change, count):
    """Frequency and damping are right, and the number of plucks is stated."""
    wanted = {"frequency": 5.0, "ratio": 0.03} | change
    found = identify(*decays(np.random.default_rng(4), **change))
    assert found.frequencies[0] == pytest.approx(wanted["frequency"], rel=3e-3)
    assert found.damping[0] == pytest.approx(wanted["ratio"], rel=0.05)
    low, high = found.damping_intervals[0]
    assert 0 < low < found.damping[0] < high < 2 * low
    assert len(found.pluck_frequencies) == (count if count > 1 else 0)
    assert any(f"plucked {count} times" in text for text in found.warnings) == (count > 1)


def test_several_plucks_tell_more_than_one():
    """The mean of three decays is surer than each of them."""
    once = identify(*decays(np.random.default_rng(5), starts=(1.0,), seconds=5.0, noise=0.05))
    often = identify(*decays(np.random.default_rng(5), noise=0.05))
    assert often.damping_deviations[0] < once.damping_deviations[0]


@pytest.mark.parametrize("change", [{"starts": (1.0,)}, {}, {"sizes": (1.0, 0.4, 1.0)}])
def test_what_a_sensor_cut_off_is_not_used(change):
    """Clipped at half of its amplitude; the converter's steps at the turns are no clipping."""
    found = identify(*decays(np.random.default_rng(6), limit=0.5, **change))
    assert any("range was too small" in text for text in found.warnings)
    assert found.frequencies[0] == pytest.approx(5.0, rel=2e-3)
    assert found.damping[0] == pytest.approx(0.03, rel=0.03)
    times, whole = decays(np.random.default_rng(6), **change)
    rounded = identify(times, np.round(whole / 0.02) * 0.02)
    assert not any("range" in text for text in rounded.warnings)


def test_beats_are_no_plucks():
    """Two close vibrations of one size swell again and again."""
    found = identify(*record(np.random.default_rng(2), frequencies=(2.3, 2.5), damping=(2e-3, 2e-3),
                             size=(1.0, 1.0), seconds=30.0, noise=0.02))
    assert not found.pluck_frequencies and len(found.frequencies) == 2


def test_plucks_of_a_branch_that_changed_are_named():
    rng = np.random.default_rng(7)
    one, two = (decays(rng, starts=(1.0,), frequency=f, seconds=6.0)[1] for f in (5.0, 5.2))
    values = np.vstack([one, two])
    found = identify(np.arange(len(values)) / 200.0, values)
    assert any("different first frequencies: 5, 5.2 Hz" in text for text in found.warnings)


REPORTS = Path(__file__).parents[3] / "shared" / "data" / "reports"


@pytest.mark.parametrize(("name", "frequency", "ratio"), [
    ("12-arduino-micros/arduino_ring.csv", 21.64, 0.004),
    ("21-logger-ring/logger_ring.csv", 21.64, 0.004),
    ("22-repeated-plucks/four_plucks.csv", 21.70, 0.10)])
def test_reported_records(name, frequency, ratio):
    """An Arduino's clock, a tree logger's columns, four plucks that the sensor cut off."""
    if not (REPORTS / name).exists():
        pytest.skip("the reports are not beside this checkout")
    record = read_record(REPORTS / name)
    found = identify(record.times, record.values)
    assert found.frequencies[0] == pytest.approx(frequency, abs=0.01)
    assert found.damping[0] == pytest.approx(ratio, rel=0.03)


@pytest.mark.parametrize("stamp", [("TIMESTAMP", lambda k: f"2024-05-01 10:11:{k / 200:09.6f}"),
                                   ("millis", lambda k: 5 * k + 1000),
                                   ("Time (s)", lambda k: k / 200)])
def test_the_readings_of_a_logger_are_found(tmp_path, stamp):
    """Beside a counter, a drifting temperature, mains hum, noise and constant columns."""
    rng = np.random.default_rng(9)
    times, values = decays(rng, starts=(1.0,), seconds=8.0)
    title, written = stamp
    rows = [f"{title},record,temp,volt,hum,ax,ay,az,status"]
    for k, (time, (value,)) in enumerate(zip(times, values, strict=True)):
        rows.append(",".join(map(str, [
            written(k), k, round(25 + 0.1 * np.sin(0.5 * time) + 0.01 * time, 4), 3.3,
            round(np.sin(2 * np.pi * 50 * time), 4), round(9.8 + value, 5),
            round(0.05 * rng.standard_normal(), 5), round(0.4 * value, 5), "OK"])))
    (tmp_path / "a.csv").write_text("\n".join(rows) + "\n")
    record = read_record(tmp_path / "a.csv")
    assert record.columns == ("ax", "az")
    assert any("taken as readings, because they ring: ax, az" in text for text in record.warnings)
    assert identify(record.times, record.values).frequencies[0] == pytest.approx(5.0, rel=2e-3)


@pytest.mark.parametrize(("head", "rate"), [
    ("# Sample rate: 200 Hz\nacc\n", None), ("Sampling Rate [Hz],200\nax,ay\n", None),
    ("sample,acc\n", 200.0), ("acc\n", 200.0)])
def test_readings_without_times_have_a_rate(tmp_path, head, rate):
    """The file states it, or the user does; without either the error names the option."""
    _, values = decays(np.random.default_rng(9), starts=(1.0,), seconds=8.0)
    rows = [{"sample,acc": f"{k},{value}", "ax,ay": f"{value},{0.4 * value}"}.get(
        head.splitlines()[-1], f"{value}") for k, value in enumerate(values[:, 0])]
    (tmp_path / "a.csv").write_text(head + "\n".join(rows) + "\n")
    record = read_record(tmp_path / "a.csv", rate)
    assert identify(record.times, record.values).frequencies[0] == pytest.approx(5.0, rel=2e-3)
    if rate:
        with pytest.raises(InputError, match="--rate-hz"):
            read_record(tmp_path / "a.csv")


@pytest.mark.parametrize("axes", [1, 3])
def test_the_magnitude_of_the_others_is_no_reading(axes):
    """Telephones add it; it rings at twice the frequency. Of two equal columns both stay."""
    times = np.arange(0, 4, 0.01)
    swing = np.exp(-0.5 * times) * np.cos(2 * np.pi * 3 * times)
    values = swing[:, None] * [[1.0, 0.4, -0.2][:axes]] * np.ones((1, axes))
    names = tuple("abcd"[:axes + 1])
    record = Stream(times, np.c_[values, np.linalg.norm(values, axis=1)], names)
    used = ringing_columns(record)
    assert used.columns == names[:-1]
    found = identify(used.times, used.values)
    assert found.frequencies[0] == pytest.approx(3.0, rel=5e-3)
    equal = Stream(times, np.c_[swing + 2, swing + 2], ("a", "b"))
    assert ringing_columns(equal).columns == ("a", "b")


def in_packets(path, size, *, within=0, jitter=0.0, lost=(), counter=False):
    """Write 8 s of a sensor that reads 62.5 times a second and sends ``size`` readings together.

    Stamps in whole milliseconds, ``within`` apart in a packet; ``jitter`` [ms] of its arrival.
    """
    rng = np.random.default_rng(size)
    times, values = decays(rng, starts=(0.5,), frequency=5.2, ratio=0.02, noise=0.03, seconds=8.0,
                           rate=62.5)
    number = np.arange(len(times))
    packet = number // size
    late = np.abs(jitter * rng.standard_normal(packet[-1] + 1))
    stamps = 16 * (packet + 1) * size + late[packet] + within * (number % size)
    kept = ~np.isin(packet, lost)
    written = np.maximum.accumulate(np.round(stamps[kept]))
    columns = [written, *([number[kept]] if counter else []), *np.round(1e3 * values[kept]).T]
    np.savetxt(path, np.column_stack(columns), "%d", ",", comments="",
               header="time_ms,sample,a" if counter else "time_ms,a")
    return path


@pytest.mark.parametrize(("size", "within", "jitter"), [
    (2, 0, 0), (3, 0, 5), (4, 1, 5), (8, 1, 5), (8, 2, 0), (16, 0, 0), (16, 1, 15), (62, 0, 0)])
def test_readings_in_packets_are_counted(tmp_path, size, within, jitter):
    """By their stamps those in packets of 8 rang at 4.2 Hz; equal stamps were refused."""
    record = read_record(in_packets(tmp_path / "a.csv", size, within=within, jitter=jitter))
    found = identify(record.times, record.values, rate_deviation=record.rate_deviation)
    assert abs(found.frequencies[0] - 5.2) < max(3 * found.frequency_deviations[0], 0.005)
    assert found.frequency_deviations[0] < 0.02
    assert found.damping[0] == pytest.approx(0.02, rel=0.05)
    text, = (text for text in record.warnings if "packets" in text)
    assert "--rate-hz" in text and "missing" not in text


@pytest.mark.parametrize("counter", [False, True])
def test_a_lost_packet_takes_its_time(tmp_path, counter):
    """The stamps jump there, or the column that counts the readings does."""
    record = read_record(in_packets(tmp_path / "a.csv", 8, within=1, jitter=5, lost=(20, 40),
                                    counter=counter))
    found = identify(record.times, record.values)
    assert found.frequencies[0] == pytest.approx(5.2, abs=0.01)
    assert any("missing before 2.8" in text for text in record.warnings) == (not counter)


def test_stamps_of_true_packets_are_kept(tmp_path):
    """A logger that reads ten times in a row and then waits has true stamps."""
    times, values = decays(np.random.default_rng(3), starts=(0.0,), frequency=2.3, seconds=20.0)
    kept = np.arange(len(times)) % 30 < 10
    np.savetxt(tmp_path / "a.csv", np.c_[times, values][kept], "%.5f", ",", header="t_s,a",
               comments="")
    record = read_record(tmp_path / "a.csv")
    assert not any("packets" in text for text in record.warnings)
    assert identify(record.times, record.values).frequencies[0] == pytest.approx(2.3, rel=5e-3)


def test_stamps_that_tell_nothing_are_asked_for(tmp_path):
    """Stamps that change every three seconds do not show the rate."""
    path = in_packets(tmp_path / "a.csv", 2)
    lines = path.read_text().splitlines()
    rows = [line.split(",") for line in lines[1:]]
    coarse = [f"{int(stamp) // 3000 * 3000},{value}" for stamp, value in rows]
    path.write_text("\n".join([lines[0], *coarse]) + "\n")
    with pytest.raises(InputError, match=r"have the time of another.*--rate-hz"):
        read_record(path)
    assert_rate_is_used(path)


def assert_rate_is_used(path):
    """With a stated rate the stamps do not matter."""
    record = read_record(path, 62.5)
    assert identify(record.times, record.values).frequencies[0] == pytest.approx(5.2, abs=0.01)
    other = read_record(path, 125.0)
    assert identify(other.times, other.values).frequencies[0] == pytest.approx(10.4, abs=0.02)
    assert any("stated rate is used" in text for text in other.warnings)


def test_a_stated_rate_is_used(tmp_path):
    """Also where stamps run backwards within a packet, which is refused without it."""
    assert_rate_is_used(in_packets(tmp_path / "a.csv", 8, within=1))
    rows = (tmp_path / "a.csv").read_text().splitlines()
    stamps = [line.split(",")[0] for line in rows[1:]]
    mixed = [f"{stamps[k // 8 * 8 + 7 - k % 8] if k // 8 * 8 + 7 < len(stamps) else stamps[k]},"
             f"{line.split(',')[1]}" for k, line in enumerate(rows[1:])]
    (tmp_path / "a.csv").write_text("\n".join([rows[0], *mixed]) + "\n")
    with pytest.raises(InputError, match=r"run backwards.*--rate-hz"):
        read_record(tmp_path / "a.csv")
    record = read_record(tmp_path / "a.csv", 62.5)
    assert identify(record.times, record.values).frequencies[0] == pytest.approx(5.2, abs=0.01)


@pytest.mark.parametrize(("size", "first", "told"), [
    ((0.1, 1.0), 5.2, "not taken for the branch"), ((0.3, 1.0), 1.3, "vibrates most at 5.2")])
def test_the_first_frequency_has_a_share_of_the_power(size, first, told):
    """A weak slow sway was taken for the branch. A strong second mode is its second."""
    times, channels = record(np.random.default_rng(2), frequencies=(1.3, 5.2), damping=(0.02, 0.02),
                             size=size, noise=0.02, seconds=15.0)
    found = identify(times, channels)
    assert found.frequencies[0] == pytest.approx(first, rel=5e-3)
    assert any(told in text for text in found.warnings)
