"""Reading a pull while it is recorded."""

import threading
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from limber.core.progress import Progress
from limber.estimation.online import follow
from limber.estimation.online.filter import OnlineState
from limber.estimation.settings import FitSpec
from limber.recordings.recording import EXACT, CalibrationEntry, write_pull
from limber.stages.moduli.estimate import _followed
from limber.store import Branch


@pytest.mark.slow
def test_rows_are_taken_as_they_are_written(tmp_path, plain_pull, monkeypatch):
    """A recorder that appends in pieces, cut inside lines: every frame comes once, in order."""
    monkeypatch.setattr(follow, "QUIET_SECONDS", 0.6)
    write_pull(tmp_path / "whole", plain_pull)
    live = tmp_path / "live"
    live.mkdir()
    (live / "pull.toml").write_text((tmp_path / "whole" / "pull.toml").read_text())
    texts = {name: (tmp_path / "whole" / name).read_text() for name in ("robot.csv", "markers.csv")}

    def record() -> None:
        for before, share in ((0.25, 0.4), (0.4, 0.7), (0.7, 1.0)):
            for name, text in texts.items():
                with open(live / name, "a") as stream:
                    stream.write(text[int(before * len(text)):int(share * len(text))])
            time.sleep(0.25)

    for name, text in texts.items():
        (live / name).write_text(text[:int(0.25 * len(text))])
    recorder = threading.Thread(target=record)
    recorder.start()
    times = [frame.time for frame, _ in follow.paced(lambda: live, 1000.0)]
    recorder.join()
    assert np.all(np.diff(times) > 0)
    assert np.allclose(times, plain_pull.observations.times)


def test_a_replay_keeps_its_pace(tmp_path, plain_pull, monkeypatch):
    """At 20 times the speed each frame comes a twentieth of its time after the first."""
    write_pull(tmp_path / "p", plain_pull)
    now = [100.0]
    monkeypatch.setattr(follow, "time", SimpleNamespace(
        monotonic=lambda: now[0], sleep=lambda seconds: now.append(now.pop() + seconds)))
    came, times = [], []
    for frame, share in follow.paced(lambda: tmp_path / "p", 20.0):
        came.append(now[0])
        times.append(frame.time)
        if share == 1.0:
            break
    assert len(times) == 60
    assert np.allclose(np.subtract(came, came[0]), np.subtract(times, times[0]) / 20.0)


@pytest.mark.parametrize(("calibration", "tells"), [(EXACT, True), (CalibrationEntry(), False)])
def test_it_says_enough_only_where_noise_alone_limits(plain_pull, calibration, tells):
    """A gripper frame a millimetre off is not in the live intervals: 2 % would be no truth."""
    pull = replace(plain_pull, entry=plain_pull.entry.model_copy(
        update={"calibration": calibration}))
    said: list[str] = []
    told = follow.begun_sentences(pull, Progress(on_warning=said.append))
    assert bool(said) is not tells
    state = OnlineState(1.0, np.array([1e7]), np.array([[0.99e7, 1.01e7]]), 1.0, True, True, False)
    follow._report("p", state, 0.5, told, Progress(on_warning=said.append))
    assert any("known to 2 %" in each for each in said) is tells
    assert any("Stop pulling" in each for each in said) is not tells


def test_a_pull_that_is_being_recorded_is_found_where_it_grows(bare_branch):
    """A recorder's lines stand beside the folder's files until it has ended."""
    settings = FitSpec(pull=("live",))
    with bare_branch.stream("pulls/live/pull.toml") as lines:
        lines.append("# growing")
        name, where = _followed(bare_branch, settings)
    assert name == "live" and (where() / "pull.toml").read_text() == "# growing\n"
    with bare_branch.stage("record:live") as stage:
        stage.adopt("pulls/live/pull.toml")
    for told in (where, _followed(bare_branch, settings)[1]):
        assert told() == bare_branch.folder / "pulls" / "live"


@pytest.mark.slow
def test_a_recording_that_ends_is_followed_to_its_last_frame(bare_branch, tmp_path, plain_pull,
                                                             monkeypatch):
    """Its files move into the branch then; slow preparations may even see nothing else of it."""
    monkeypatch.setattr(follow, "QUIET_SECONDS", 1.5)
    write_pull(tmp_path / "whole", plain_pull)
    names = ("pull.toml", "robot.csv", "markers.csv")
    streams = [bare_branch.stream(f"pulls/live/{name}") for name in names]
    texts = [(tmp_path / "whole" / name).read_text().splitlines() for name in names]
    for stream, lines in zip(streams, texts, strict=True):
        for line in lines if stream is streams[0] else lines[:len(lines) // 2]:
            stream.append(line)
    times = []
    for frame, _ in follow.paced(_followed(bare_branch, FitSpec(pull=("live",)))[1], 1e3):
        times.append(frame.time)
        if len(times) == 10:
            for stream, lines in zip(streams[1:], texts[1:], strict=True):
                for line in lines[len(lines) // 2:]:
                    stream.append(line)
            with bare_branch.stage("record:live") as stage:
                for stream, name in zip(streams, names, strict=True):
                    stream.close()
                    stage.adopt(f"pulls/live/{name}")
    assert np.allclose(times, plain_pull.observations.times)


@pytest.fixture
def bare_branch(tmp_path):
    return Branch.create(tmp_path / "bare.branch")
