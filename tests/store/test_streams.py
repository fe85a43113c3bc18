"""Streams: lines that grow, survive a kill, and are gone on with."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from limber.core.errors import BranchFolderError, InputError, WorkError
from limber.store import Branch, Stream, stream_lines

_WRITER = """
import sys, time
from limber.store import Stream
stream = Stream(sys.argv[1])
number = 0
while True:
    number += 1
    line = f"{number},{time.monotonic()}"
    stream.append(line)
    print(line, flush=True)
    time.sleep(0.002)
"""


def test_lines_come_back_in_order_and_are_gone_on_with(tmp_path: Path):
    """Closed and opened again, a stream keeps what it had."""
    path = tmp_path / "log" / "a.csv"
    for part in range(2):
        with Stream(path) as stream:
            for line in range(1000):
                stream.append(f"{part},{line},µ")
    lines = list(stream_lines(path))
    assert lines == [f"{part},{line},µ" for part in range(2) for line in range(1000)]


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="POSIX signals")
def test_kill_9_loses_at_most_a_second(tmp_path: Path):
    """A writer at 500 lines a second is killed: all but its last second is there, and whole."""
    path = tmp_path / "robot.csv"
    with open(tmp_path / "said.txt", "w") as said:
        process = subprocess.Popen([sys.executable, "-c", _WRITER, str(path)], stdout=said)
        while (tmp_path / "said.txt").read_text().count("\n") < 800:
            assert process.poll() is None
            time.sleep(0.05)
        process.send_signal(signal.SIGKILL)
        process.wait()
    appended = (tmp_path / "said.txt").read_text().splitlines()
    lines = [line.split(",") for line in stream_lines(path)]
    assert [int(number) for number, _ in lines] == list(range(1, len(lines) + 1))
    # By the writer's own clock, which stands still where the machine does.
    assert float(appended[-1].split(",")[1]) - float(lines[-1][1]) < 1.0
    with Stream(path) as stream:
        stream.append("after")
    assert list(stream_lines(path))[-1] == "after"


@pytest.mark.parametrize("torn", [b"3,fo", b"x" * 200_000])
def test_a_torn_last_line_is_left_out_and_cut(tmp_path: Path, torn: bytes):
    """A reader does not see half a line; who takes the stream over cuts it away."""
    path = tmp_path / "a.csv"
    path.write_bytes(b"1,one\n2,two\n" + torn)
    assert list(stream_lines(path)) == ["1,one", "2,two"]
    with Stream(path) as stream:
        assert stream.cut_bytes == len(torn)
        stream.append("3,three")
    assert path.read_bytes() == b"1,one\n2,two\n3,three\n"


def test_nothing_but_a_torn_line_is_an_empty_stream(tmp_path: Path):
    path = tmp_path / "a.csv"
    path.write_bytes(b"time,for")
    with Stream(path) as stream:
        assert stream.cut_bytes == 8
    assert path.read_bytes() == b""


def test_two_writers_of_one_stream_are_refused(tmp_path: Path):
    """The second is told; the first goes on."""
    with Stream(tmp_path / "a.csv") as stream:
        program = ("import sys; from limber.store import Stream\n"
                   "try: Stream(sys.argv[1])\n"
                   "except Exception as e: print(type(e).__name__, e)\n")
        said = subprocess.run([sys.executable, "-c", program, str(tmp_path / "a.csv")],
                              capture_output=True, text=True, check=True).stdout
        assert said.startswith("BranchFolderError Another program is appending")
        stream.append("1")
    assert list(stream_lines(tmp_path / "a.csv")) == ["1"]


def test_a_line_end_in_a_line_is_refused(tmp_path: Path):
    with Stream(tmp_path / "a.csv") as stream, pytest.raises(InputError, match="line break"):
        stream.append("1\n2")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")
def test_a_full_disk_is_said(tmp_path: Path):
    """What could not be written is an error at the next line or at the end, not silence."""
    (tmp_path / "a.csv").symlink_to("/dev/full")
    stream = Stream(tmp_path / "a.csv")
    stream.append("1")
    with pytest.raises(WorkError, match="could not be written"):
        stream.close()


def test_a_stage_takes_a_stream_over(tmp_path: Path):
    """Until then it is listed as left; then it is a file of the branch as any other."""
    branch = Branch.create(tmp_path / "apple.branch")
    with branch.stream("pulls/a/robot.csv") as stream:
        stream.append("time,force")
    assert Branch.open(branch.folder).streams() == ["pulls/a/robot.csv"]
    with pytest.raises(BranchFolderError), branch.stage("pull:a") as stage:
        stage.adopt("pulls/a/robot.csv")
        raise BranchFolderError("no")
    assert branch.streams() == ["pulls/a/robot.csv"]
    with branch.stage("pull:a") as stage:
        stage.adopt("pulls/a/robot.csv")
    assert branch.streams() == []
    assert Branch.open(branch.folder, verify=True).path(
        "pulls/a/robot.csv").read_text() == "time,force\n"
