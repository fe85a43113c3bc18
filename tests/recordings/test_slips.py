"""Hand-made tables with a slip: it is named when they are imported."""

from dataclasses import replace

import numpy as np
import pytest

from limber.core.alignment import Alignment
from limber.core.errors import InputError
from limber.recordings.import_request import likely_slip, require_no_slip
from limber.recordings.recording import Observations


@pytest.mark.parametrize(("change", "told"), [
    (lambda p: {"times": 1e3 * p.times}, "gripper span.*milliseconds.*t_ms"),
    (lambda p: {"times": 1e3 * p.times, "observations": None}, "longer than an hour.*t_ms"),
    (lambda p: {"observations": Observations(1e3 * p.observations.times,
                                             p.observations.positions)}, "markers span.*t_ms"),
    (lambda p: {"poses": np.degrees(p.poses + [0, 0, 0, 0, 0, 0.3])}, "degrees.*rx_deg"),
    (lambda p: {"poses": p.poses * [1e3, 1e3, 1e3, 1, 1, 1]}, "m/s.*millimetres.*x_mm"),
    (lambda p: {"wrenches": np.zeros_like(p.wrenches)}, "zero in all.*remove the columns")])
def test_what_no_robot_does_is_refused(plain_pull, change, told):
    """Physical limits: 5 m/s, a turn, an hour; two tables of one pull last about as long."""
    assert require_no_slip(plain_pull) == plain_pull
    if "hour" in told:
        plain_pull = replace(plain_pull, times=3.0 * plain_pull.times)
    with pytest.raises(InputError, match=told):
        require_no_slip(replace(plain_pull, **change(plain_pull)))


def test_a_pull_without_force_is_named(plain_pull):
    found = require_no_slip(replace(plain_pull, wrenches=np.full_like(plain_pull.wrenches, np.nan)))
    assert "has no force" in found.warnings[-1]


@pytest.mark.parametrize(("change", "told"), [
    (lambda p: 1e3 * p, "millimetres"), (lambda p: p[:, [2, 1, 0]], "likely z, y, x"),
    (lambda p: p[:, [1, 2, 0]], "likely y, z, x"), (lambda p: p - [0.5, 0, 0.2], "of the scan"),
    (lambda p: p + 3.0, "")])
def test_the_slip_that_puts_points_on_the_branch(change, told):
    """Millimetres, exchanged titles, the scan's frame; none where none fits."""
    nodes = np.linspace([0.0, 0.1, 0.0], [0.05, 0.1, 0.8], 200)
    points = nodes[[50, 120, 190]]
    found = likely_slip(change(points), nodes, Alignment(origin=(-0.5, 0.0, -0.2)), 0.02)
    assert (told in found) if told else not found
