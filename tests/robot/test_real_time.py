"""What keeps a robot's loop from being held up."""

import os
import subprocess
import sys

import pytest

from limber.robot.driver.real_time import keep_awake

_COUNTED = """
import gc
import limber.robot.driver.driver
from limber.robot.driver.real_time import spare_what_is_loaded
before = len(gc.get_objects())
spare_what_is_loaded()
print(before, len(gc.get_objects()))
"""


_ALONE = """
import os
from limber.robot.driver.real_time import claim_real_time
os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))  # not what a test before has left
print(claim_real_time(), os.sched_getscheduler(0) == os.SCHED_OTHER)
"""


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="no affinity on this system")
def test_a_single_processor_is_not_taken_from_the_program_that_gives_orders():
    """There its orders and the robot's samples did not arrive for seconds."""
    asked = subprocess.run([sys.executable, "-c", _ALONE], capture_output=True, text=True,
                           check=True).stdout.split()
    assert asked == ["False", "True"]


@pytest.mark.slow
def test_a_search_for_garbage_no_longer_goes_through_what_is_loaded():
    """Else one takes longer than a loop may be silent, some minutes into a motion."""
    counted = subprocess.run([sys.executable, "-c", _COUNTED], capture_output=True, text=True,
                             check=True).stdout.split()
    before, after = map(int, counted)
    assert before > 20_000
    assert after < 1_000


_KEPT = """
import limber.robot.driver.driver
from limber.robot.driver.real_time import spare_what_is_loaded
kept = spare_what_is_loaded()
lines = dict(line.split(":") for line in open("/proc/self/status") if line.startswith("Vm"))
print(kept, lines["VmLck"].split()[0], lines["VmSize"].split()[0])
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="memory is locked on Linux only")
def test_what_is_loaded_stays_in_memory():
    """Else the first motion after a minute's rest waits for the disk."""
    kept, locked, whole = subprocess.run(
        [sys.executable, "-c", _KEPT], capture_output=True, text=True, check=True).stdout.split()
    if kept == "False":
        pytest.skip("this user may not lock so much memory")
    assert int(locked) > 0.9 * int(whole)


_AWAKE = """
import struct
from pathlib import Path
from limber.robot.driver.real_time import keep_awake
print(keep_awake(), *struct.unpack("i", Path("/dev/cpu_dma_latency").read_bytes()[:4]))
"""


@pytest.mark.skipif(not os.access("/dev/cpu_dma_latency", os.R_OK | os.W_OK),
                    reason="this user may not keep processors awake here")
def test_processors_stay_awake_as_long_as_the_process_runs():
    """The system reads back what holds: no latency at all."""
    asked = subprocess.run([sys.executable, "-c", _AWAKE], capture_output=True, text=True,
                           check=True).stdout.split()
    assert asked == ["True", "0"]


def test_a_computer_without_that_device_is_told(monkeypatch, tmp_path):
    monkeypatch.setattr("limber.robot.driver.real_time._WAKING", tmp_path / "none")
    assert not keep_awake()


_STUCK = """
import queue, threading, time
import limber.robot.driver.driver as driver
driver._LAST_SECONDS = 0.2
threading.Thread(target=driver._read_orders, args=(queue.SimpleQueue(),), daemon=True).start()
time.sleep(60)
"""


@pytest.mark.slow
def test_a_driver_that_is_stuck_ends_when_nobody_gives_it_orders():
    """Its recorder was killed and its robot closed: it kept a processor busy for minutes."""
    ended = subprocess.run([sys.executable, "-c", _STUCK], stdin=subprocess.DEVNULL, timeout=30,
                           check=False)
    assert ended.returncode == 3
