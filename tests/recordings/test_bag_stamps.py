"""Bags whose first messages have no time, as drivers publish them before their clock is set."""

from pathlib import Path

import numpy as np
import pytest

from limber.core.errors import InputError
from limber.recordings.bag_pull import pull_of_bag
from limber.recordings.bag_reader import Bag, Topic, read_bag, stamped
from limber.recordings.settings import ImportSettings

REPORTED = (Path(__file__).parents[3] / "shared" / "data" / "reports" / "13-mcap-zero-stamps"
            / "zero5.mcap")
COUNT, EPOCH = 20, 1.7e9
LOGGED = EPOCH + 0.25 * np.arange(COUNT)


def bag(stamps, logged=LOGGED, kind="pose"):
    topic = Topic("/a", "branch", np.array(stamps, float), np.array(logged, float),
                  np.arange(7.0 * COUNT).reshape(COUNT, 7))
    return Bag(Path("a.mcap"), {kind: (topic,)}, (), 0)


@pytest.mark.parametrize("clock", ["header", "log"])
def test_the_reported_bag(tmp_path, clock):
    """A pull of about 5 s, with a word on what was left out."""
    pytest.importorskip("rosbags")
    if not REPORTED.exists():
        pytest.skip("the reports are not beside this checkout")
    found = pull_of_bag(read_bag(REPORTED), tmp_path, ImportSettings(bag_clock=clock))
    assert found.robot.times[-1] == pytest.approx(5.2, abs=0.1) and len(found.robot.times) == 21
    assert sum("have a time of 0" in text for text in found.warnings) == 3


@pytest.mark.parametrize("bad", [[0, 1, 2], [7], [0, 10, 19]])
@pytest.mark.parametrize("value", [0.0, 12.5, EPOCH - 1e6, np.nan])
def test_times_that_cannot_be_are_left_out(bad, value):
    """Zeros, a clock that is set later, none: at the start, in the middle, at the end."""
    stamps, warnings = LOGGED + 0.01, []
    stamps[bad] = value
    topic, = stamped(bag(stamps), "stamps", warnings).of("pose")
    np.testing.assert_array_equal(topic.stamps, np.delete(LOGGED + 0.01, bad))
    assert topic.values.shape == (COUNT - len(bad), 7) and f"{len(bad)} of 20" in warnings[0]


@pytest.mark.parametrize("stamps", [LOGGED, LOGGED + 9e6, 0.25 * np.arange(COUNT)])
def test_clocks_of_their_own_stay(stamps):
    """Another zero of time is no fault; one that begins with 0 neither."""
    warnings = []
    topic, = stamped(bag(stamps), "stamps", warnings).of("pose")
    assert len(topic.stamps) == COUNT and not warnings


def test_a_topic_without_times_is_refused():
    with pytest.raises(InputError, match="--bag-clock log"):
        stamped(bag(np.zeros(COUNT)), "stamps", [])
    assert len(stamped(bag(np.zeros(COUNT), kind="camera"), "stamps", []).of("camera"))
