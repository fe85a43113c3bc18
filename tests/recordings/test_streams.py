"""Time-stamped tables and what is wrong with them."""

from pathlib import Path

import numpy as np
import pytest

from limber.core.errors import InputError
from limber.recordings import time_series


def written(tmp_path, text: str):
    path = tmp_path / "robot.csv"
    path.write_text(text)
    return path


def test_round_trip_keeps_numbers_and_gaps(tmp_path):
    """What is written comes back, with NaN as an empty field."""
    values = np.array([[1.25, np.nan], [2.5, -3e-4], [0.0, 7.0]])
    made = time_series.Stream(np.array([0.0, 0.1, 0.25]), values, ("a", "b"))
    time_series.write_stream(tmp_path / "s.csv", made)
    stream = time_series.read_stream(tmp_path / "s.csv")
    assert stream.columns == ("a", "b") and not stream.warnings
    assert np.array_equal(stream.times, [0.0, 0.1, 0.25])
    assert np.allclose(stream.values, values, equal_nan=True)


def test_out_of_order_and_duplicates_are_repaired_with_a_word(tmp_path):
    """Rows are sorted, of equal stamps the first stays; both are told."""
    rows = [f"{0.1 * k:.1f},{k}" for k in range(30)]
    rows[10], rows[11] = rows[11], rows[10]
    rows.insert(21, "2.0,99")
    stream = time_series.read_stream(written(tmp_path, "t_s,x\n" + "\n".join(rows) + "\n"))
    assert np.array_equal(stream.values[:, 0], np.arange(30))
    assert any("out of order" in w for w in stream.warnings)
    assert any("duplicate" in w for w in stream.warnings)


def test_a_clock_that_runs_backwards_is_refused(tmp_path):
    """Too many backward steps are no clock: sorting would invent a motion."""
    rows = [f"{t},{k}" for k, t in enumerate([3, 1, 4, 1.5, 9, 2, 6])]
    with pytest.raises(InputError, match="backwards"):
        time_series.read_stream(written(tmp_path, "t_s,x\n" + "\n".join(rows) + "\n"))


def test_a_recording_that_ends_inside_a_line(tmp_path):
    """The unfinished line goes, also where the cut leaves as many numbers as there should be."""
    for tail in ("0.3,3.1", "0.3", "0.3,-"):
        stream = time_series.read_stream(written(tmp_path, f"t_s,x\n0.1,1\n0.2,2\n{tail}"))
        assert len(stream) == 2 and "incomplete" in stream.warnings[0]


def test_rubbish_in_the_middle_is_named_by_line(tmp_path):
    """A line that is no numbers stops the reading: skipping it could hide a shifted column."""
    with pytest.raises(InputError, match="line 3"):
        time_series.read_stream(written(tmp_path, "t_s,x\n0.1,1\n0.2,abc\n0.3,2\n"))
    with pytest.raises(InputError, match="t_s"):
        time_series.read_stream(written(tmp_path, "time,x\n0.1,1\n"))
    with pytest.raises(InputError, match="empty"):
        time_series.read_stream(written(tmp_path, ""))
    with pytest.raises(InputError, match="two samples"):
        time_series.read_stream(written(tmp_path, "t_s,x\n0.1,1\n"))


def test_gaps():
    """A step of over five median steps is a gap; times strictly inside it are known."""
    times = np.r_[np.arange(0, 1, 0.01), np.arange(1.5, 2, 0.01)]
    found = time_series.gaps(times)
    assert found.shape == (1, 2) and np.allclose(found, [[0.99, 1.5]])
    assert time_series.inside_gap(np.array([0.99, 1.2, 1.5]), found).tolist() == [0, 1, 0]


@pytest.mark.parametrize("seed", range(5))
def test_spikes_are_found_and_a_fast_pull_is_not_one(seed):
    """Single and double spikes in a noisy ramp are found, the ramp itself never."""
    rng = np.random.default_rng(seed)
    time = np.linspace(0, 1, 80)
    force = np.column_stack([8 * time**2, -3 * time, 0 * time]) + 0.05 * rng.standard_normal(
        (80, 3))
    assert not time_series.spikes(force).any()
    force[30, 1] += 4.0
    force[50:52, 0] -= 3.0
    assert np.flatnonzero(time_series.spikes(force)).tolist() == [30, 50, 51]


def test_few_frames_with_noise_have_no_spikes():
    """24 frames of a virtual pull's force: monotonic axes, or axes that are not measured, must not
    make the scale vanish."""
    hits = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        time = np.linspace(0, 1, 24)
        force = np.column_stack([time**2, np.sin(2 * time), 0 * time])
        measured = force + 0.02 * rng.standard_normal((24, 3))
        hits += int(time_series.spikes(measured * [1, seed % 2, seed % 2]).sum())
    assert hits <= 2


def test_saturation_is_a_run_at_the_extreme():
    """Equal readings at the top are saturation; one single maximum is not."""
    force = np.array([[1.0], [2.0], [5.0], [5.0], [5.0], [5.0], [3.0], [1.0]])
    assert np.flatnonzero(time_series.saturated(force)).tolist() == [2, 3, 4, 5]
    assert not time_series.saturated(np.array([[1.0], [2.0], [5.0], [4.0], [3.0], [1.0]])).any()
    assert not time_series.saturated(np.zeros((10, 3))).any()


@pytest.mark.parametrize("step", [1e-300, 1e-10, 1e12])
def test_stamps_of_no_recorder(step):
    """Hardly any time between them, or ages: a spectrum would have no finite frequency."""
    count = np.arange(9.0)
    with pytest.raises(InputError, match="apart"):
        time_series.in_order(Path("a.csv"), step * count, np.zeros((9, 1)), [])
    assert len(time_series.in_order(Path("a.csv"), count, np.zeros((9, 1)), [])[0]) == 9


def test_rows_that_share_their_times():
    """Half of them or more: a clock of whole seconds, or a row for each of two markers."""
    rows = np.arange(40.0)[:, None]
    for share in (2, 10):
        with pytest.raises(InputError, match="the time of another row"):
            time_series.in_order(Path("a.csv"), np.arange(40) // share * 1.0, rows, [])
    told: list[str] = []
    stamps = np.sort(np.r_[np.arange(30.0), np.arange(10.0)])
    times, values = time_series.in_order(Path("a.csv"), stamps, rows, told)
    assert len(times) == len(values) == 30 and "10 duplicate" in told[0]
