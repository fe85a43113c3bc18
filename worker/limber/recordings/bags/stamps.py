"""Messages whose header has no time, or an impossible one."""

from dataclasses import replace

import numpy as np

from limber.core.errors import InputError
from limber.recordings.bags.bag_reader import Bag, Topic

_OFF_S = 3600.0
"""Largest distance from the topic's other stamps that a clock's drift can explain."""


def stamped(bag: Bag, clock: str, warnings: list[str]) -> Bag:
    """Return a bag without the messages whose time is 0 or far from the others of their topic.

    Drivers publish a few messages before their clock is set. Static data (a transform sent once or
    twice, camera intrinsics) keep their time. Adds a sentence to ``warnings`` for each topic.

    Args:
        bag: As read.
        clock: ``stamps`` or ``logged``: which of a topic's times count.
        warnings: Gets a sentence on the messages left out.

    Raises:
        InputError: most of a topic's messages have no time.
    """
    return replace(bag, kinds={
        kind: tuple(_of_topic(bag, topic, clock, warnings) if kind != "camera"
                    and len(topic.stamps) > 2 else topic for topic in topics)
        for kind, topics in bag.kinds.items()})


def _of_topic(bag: Bag, topic: Topic, clock: str, warnings: list[str]) -> Topic:
    times = getattr(topic, clock)
    zero = times == 0
    known = np.isfinite(times) & (times > 0)
    if 2 * np.count_nonzero(known) <= len(times):
        other = "log" if clock == "stamps" else "header"
        raise InputError(
            f"{bag.path}: {int((~known).sum())} of {len(times)} messages of {topic.name} have no "
            f"time in their {'headers' if clock == 'stamps' else 'log'}.",
            "Their order in time is not known from there.",
            f"Use the other times: --bag-clock {other}.")
    # The other clock continues while a driver's is set.
    lead = topic.stamps - topic.logged
    good = known & (np.abs(lead - np.median(lead[known])) < _OFF_S)
    if zero.sum() == 1 and np.median(times[known]) < _OFF_S:
        # A separate clock starts at 0, for example that of a simulation.
        good |= zero
    if good.all():
        return topic
    warnings.append(f"{bag.path.name}: {int((~good).sum())} of {len(times)} messages of "
                    f"{topic.name} have a time of 0, or one far from the others. They were "
                    "discarded.")
    rows = good if topic.counts is None else np.repeat(good, topic.counts)
    return replace(topic, stamps=topic.stamps[good], logged=topic.logged[good],
                   values=topic.values[rows],
                   counts=None if topic.counts is None else topic.counts[good])
