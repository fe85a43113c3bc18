"""A digital output of a controller, switched without its control program.

It works while the arm is stopped, and every wait in it has a limit: a gripper has to open even if
nothing else works.
"""

import time

from limber.core.errors import WorkError
from limber.robot.ur.samples import SampleStream

_SECONDS = 1.0


class _Outputs(SampleStream):
    inputs = ("standard_digital_output_mask", "standard_digital_output")


def switch_output(address: str, number: int, on: bool) -> None:
    """Switch a standard digital output.

    Raises:
        WorkError: no answer, another program drives the outputs, or the output did not switch.
    """
    bit = 1 << number
    stream = _Outputs(address)
    try:
        stream.write({"standard_digital_output_mask": bit,
                      "standard_digital_output": bit if on else 0})
        end = time.monotonic() + _SECONDS
        while time.monotonic() < end:
            for sample in stream.read(0.1):
                if sample.outputs is not None and bool(sample.outputs & bit) == on:
                    return
    except OSError as error:
        raise WorkError(f"The output could not be switched ({error}).", "", "See the pendant."
                        ) from error
    finally:
        stream.close()
    raise WorkError(f"Digital output {number} did not switch within {_SECONDS:g} s.",
                    "Its state as the controller sends it is unchanged.",
                    "Check on the pendant that this output is free for programs.")
