"""A format of recordings of another package: registered, `limber import-pull` takes it."""

import json

import numpy as np
import pytest

from limber.cli.main import call
from limber.recordings.recording import read_pull, write_pull
from limber.recordings.recording_formats import RECORDINGS, RecordingFormat
from limber.recordings.time_series import Stream
from limber.stages.registry import stage_class


class Tracks:
    """Times and places of markers in millimetres, as arrays."""

    @staticmethod
    def write(seen, path):
        with open(path, "wb") as stream:
            np.savez(stream, times=seen.times, places=1e3 * seen.positions)

    @staticmethod
    def read(path, request):
        with np.load(path) as held:
            places = 1e-3 * held["places"]
            labels = [f"m{k}" for k in range(places.shape[1])]
            columns = tuple(f"{label}_{axis}_m" for label in labels for axis in "xyz")
            return Stream(held["times"], places.reshape(len(places), -1), columns), labels


@pytest.fixture
def tracks(tmp_path, plain_pull):
    # A stage's help lists the formats that there are when it is loaded: other tests' as well.
    stage_class("import-pull")
    RECORDINGS.register(RecordingFormat("tracks", (".foo",), Tracks.read, holds="markers"))
    Tracks.write(plain_pull.observations, tmp_path / "a.foo")
    write_pull(tmp_path / "made", plain_pull)
    yield tmp_path / "a.foo"
    del RECORDINGS.formats[0]


@pytest.mark.parametrize("given", [[], ["--kind", "tracks"]])
def test_import_pull_takes_it(tracks, given, bare_folder, plain_pull, capsys):
    """Found by its suffix, or named; the robot's table is that of any markers."""
    assert call(["import-pull", str(bare_folder), str(tracks), "--name", "a", *given, "--robot",
                 str(tracks.parent / "made" / "robot.csv"), "--time-offset", "0", "--json"]) == 0
    told = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert told["kind"] == "tracks" and told["frame_count"] == 60 and told["point_count"] == 2
    pull = read_pull(bare_folder / "pulls" / "a")
    np.testing.assert_allclose(pull.observations.positions, plain_pull.observations.positions,
                               atol=1e-9)


def test_it_is_listed_among_the_kinds(tracks, bare_folder, capsys):
    """Of a kind that nobody knows it is said which there are."""
    assert call(["import-pull", str(bare_folder), str(tracks), "--name", "a", "--kind",
                 "nonsense"]) == 2
    assert "tracks" in capsys.readouterr().err
    tracks.write_bytes(b"nonsense")
    assert call(["import-pull", str(bare_folder), str(tracks), "--name", "a"]) == 2
    assert "cannot be read" in capsys.readouterr().err
