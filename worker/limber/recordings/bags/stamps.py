"""Messages whose header has no time, or one that cannot be."""

from dataclasses import replace

import numpy as np

from limber.core.errors import InputError
from limber.recordings.bags.bag_reader import Bag, Topic

_OFF_S = 3600.0
"""Farther than this from what the topic's other stamps say, no clock's drift is it."""


def stamped(bag: Bag, clock: str, warnings: list[str]) -> Bag:
    """Return a bag without the messages whose time is 0 or far from all others of their topic.

    Drivers publish a few before their clock is set. What holds at all times (a transform that is
    sent once or twice, a camera's numbers) keeps its time. Adds a sentence to ``warnings`` for
    each topic.

    Args:
        bag: As read.
        clock: ``stamps`` or ``logged``, which of a topic's times count.
        warnings: Gets what was left out.

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
    # The other clock runs on while a driver's is set.
    lead = topic.stamps - topic.logged
    good = known & (np.abs(lead - np.median(lead[known])) < _OFF_S)
    if zero.sum() == 1 and np.median(times[known]) < _OFF_S:
        # A clock of its own begins with 0, that of a simulation for one.
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
