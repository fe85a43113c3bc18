"""The process that moves the robot: ``python -m limber.robot.driver.driver``.

ur-rtde has wheels for Python 3.11 and 3.12 only, holds the interpreter while it connects, and ends
the whole process if a connection breaks at a bad moment. So it has a process of its own. Orders
come as JSON lines on standard input, samples and events go out as JSON lines. When the input ends,
for example because the parent is killed, the robot is stopped and the process ends.
"""

import json
import os
import queue
import signal
import sys
import threading
import time

from limber.cell.cell_file import Cell
from limber.core.errors import LimberError
from limber.robot.driver.control_loop import Driver, Orders
from limber.robot.driver.real_time import Words, clear_deadline

_LAST_SECONDS = 10.0  # after the last order; a stop takes at most one second


def _read_orders(orders: Orders) -> None:
    for line in sys.stdin:
        try:
            orders.put(json.loads(line))
        except json.JSONDecodeError:
            orders.put({"order": line.strip()[:40]})
    orders.put(None)
    # ur-rtde may wait for ever for a lost robot too: no other process is left to end this one, and
    # it has priority over all others.
    time.sleep(_LAST_SECONDS)
    os._exit(3)


def main() -> int:
    """Read the cell from the first line of standard input, then serve; returns an exit code."""
    # ur-rtde prints on standard output; the driver's messages go through a copy of it.
    words = Words(os.fdopen(os.dup(1), "w", encoding="utf-8"))
    os.dup2(2, 1)
    driver: Driver | None = None
    # From here on the process waits for the robot, not for this computer.
    words.tell(event="starting")
    try:
        driver = Driver(Cell.model_validate_json(sys.stdin.readline()), words)
        driver.tell(event="connected", **driver.facts)
        orders: Orders = queue.SimpleQueue()
        threading.Thread(target=_read_orders, args=(orders,), daemon=True).start()
        # If a whole process group is asked to end, the arm is stopped in order, not by its
        # watchdog. This process then ends with the one that gives it orders.
        signal.signal(signal.SIGTERM, lambda *_: orders.put({"order": "stop"}))
        driver.run(orders)
    except (LimberError, RuntimeError, ConnectionError, ImportError) as error:
        words.tell(event="failed", reason=str(error), code=getattr(error, "exit_code", 3))
        return 3
    finally:
        if driver is not None and not driver.ended:
            driver.close()
        # From here on nothing waits for the robot: the last messages may take their time.
        clear_deadline()
        words.close()
    # Do not wait for ur-rtde's threads.
    os._exit(0)


if __name__ == "__main__":
    sys.exit(main())
