"""What keeps a robot's loop from being held up."""

import subprocess
import sys

_COUNTED = """
import gc
import limber.robot.driver
from limber.robot.real_time import spare_what_is_loaded
before = len(gc.get_objects())
spare_what_is_loaded()
print(before, len(gc.get_objects()))
"""


def test_a_search_for_garbage_no_longer_goes_through_what_is_loaded():
    """Else one takes longer than a loop may be silent, some minutes into a motion."""
    counted = subprocess.run([sys.executable, "-c", _COUNTED], capture_output=True, text=True,
                             check=True).stdout.split()
    before, after = map(int, counted)
    assert before > 20_000
    assert after < 1_000
