"""Weather and cuts in a session: as `limber load` has them, on the branch that is held."""

import json
import shutil
from concurrent.futures import Future
from dataclasses import replace
from threading import Event

import numpy as np
import pytest

from limber.core.errors import Cancelled, InputError, WorkError
from limber.core.progress import SILENT
from limber.geometry.skeleton.skeleton import Skeleton
from limber.mechanics.added_masses import PointMass
from limber.mechanics.loads.load_effects import load_effects
from limber.mechanics.loads.outdoor import LoadedOutdoors, Outdoors
from limber.session import protocol
from limber.session.protocol import SessionSettings
from limber.session.session_branch import HeldBranch, load_held
from limber.session.worker import EffectsTeller, effects_of, gusts_of
from limber.stages.motion.load import ApplyLoads
from limber.store import Branch
from limber.store.loading import load_branch, load_skeleton

AXIS = Skeleton.from_edges(np.column_stack([np.zeros((21, 2)), np.linspace(0, 0.2, 21)]),
                           np.arange(-1, 20), np.linspace(0.004, 0.003, 21))


@pytest.fixture()
def held(branch_folder) -> HeldBranch:
    return HeldBranch(load_branch(Branch.open(branch_folder)), AXIS)


@pytest.mark.parametrize(("loads", "share"), [
    (Outdoors(wind=(6.0, 0.0, 0.0)), 1e-5),
    (Outdoors(fruit=(PointMass((0.0, 0.0, 0.19), 0.02),)), 1e-5),
    # Of a cut the session keeps the stress that the whole weight had left: a second-order part.
    (Outdoors(wind=(3.0, 1.0, 0.0), snow=5.0, cuts=((0.0, 0.0, 0.12),)), 0.03)])
def test_the_branch_rests_where_load_says(held, loads, share):
    """The full model with the same masses, winds and cuts comes to rest at the same place."""
    held.set_outdoors(loads)
    answer = held.solve()
    model = held.loaded.model
    other = LoadedOutdoors(model, AXIS, loads)
    result = other.rest()
    kept = np.unique(model.mesh.tets[~other.is_gone])
    size = np.abs(result.displacement[kept]).max()
    assert size > 1e-6
    np.testing.assert_allclose(answer.displacement[kept], result.displacement[kept],
                               atol=share * size)
    _, greatest, _ = held.strain(answer)
    assert greatest == pytest.approx(other.greatest_strain(result), rel=0.03)
    down = -result.displacement[kept, 2]
    assert held.sag(answer) == pytest.approx(down[np.abs(down).argmax()], rel=0.03)


def test_what_is_cut_off_is_told_and_comes_back(held):
    held.set_outdoors(Outdoors(cuts=((0.0, 0.0, 0.12),)))
    gone = held.vertices_gone()
    heights = held.model.mesh.nodes[held.surface][:, 2]
    assert heights[gone].min() > 0.11 and set(np.flatnonzero(heights > 0.13)) <= set(gone)
    held.set_outdoors(Outdoors())
    assert held.loads is None and not len(held.vertices_gone())


def test_without_axes_it_is_said(branch_folder):
    with pytest.raises(InputError, match="no axes"):
        load_held(branch_folder, SessionSettings()).set_outdoors(Outdoors(wind=(1.0, 0.0, 0.0)))


@pytest.fixture()
def with_axes(branch_folder, tmp_path):
    folder = shutil.copytree(branch_folder, tmp_path / "axes.branch")
    with Branch.open(folder).stage("axes") as stage:
        AXIS.write_swc(stage.path("skeleton.swc"))
    return folder


class Said:
    """Keeps events, and waits for one."""

    def __init__(self):
        self.lines, self.over = [], Event()

    def say(self, **line):
        self.lines.append(line)
        self.over.set()


_GUSTY = json.dumps({"command": "effects", "id": 8, "gust_record": {
    "time_s": [k / 10 for k in range(100)], "speed_m_s": [6.0] * 100}}).encode()


def test_gusts_in_a_session(with_axes):
    """They push as `limber load` has it; without a wind, or with a record of none, it is said."""
    held = load_held(with_axes, SessionSettings())
    loads = Outdoors(wind=(6.0, 0.0, 0.0))
    question = protocol.parse_command(b'{"command": "effects", "gust": 0.3}')
    told = effects_of(with_axes, SessionSettings(), held.young, loads, gusts_of(question),
                      question, SILENT)
    as_load = ApplyLoads(branch_folder=with_axes, wind=(6.0, 0.0, 0.0), gust=0.3).run()
    assert told["gusts"]["factor"] == pytest.approx(as_load["gusts"]["factor"], rel=1e-6)
    assert told["greatest_strain"] == pytest.approx(as_load["greatest_strain"], rel=1e-6)
    teller = EffectsTeller(with_axes, SessionSettings(), Said())
    held.set_outdoors(Outdoors(snow=1.0))
    with pytest.raises(InputError, match="without a wind"):
        teller.ask(question, held)
    held.set_outdoors(loads)
    for times in ([0.0], [1.0] * 20):
        record = {"time_s": times, "speed_m_s": [6.0] * len(times)}
        with pytest.raises(InputError, match="not a wind record"):
            teller.ask(protocol.parse_command(json.dumps(
                {"command": "effects", "gust_record": record}).encode()), held)
    with pytest.raises(protocol.NotUnderstood, match="not both"):
        protocol.parse_command(_GUSTY.replace(b'"id": 8', b'"gust": 0.3'))


@pytest.mark.slow
def test_what_loads_do_is_told(with_axes):
    """As `limber load` tells it, of the branch as it is now; one question at a time."""
    held = load_held(with_axes, SessionSettings())
    said = Said()
    teller = EffectsTeller(with_axes, SessionSettings(), said)
    question = protocol.parse_command(b'{"command": "effects", "id": 7, "limit_load": true}')
    with pytest.raises(InputError, match="no wind, snow"):
        teller.ask(question, held)
    loads = Outdoors(wind=(3.0, 0.0, 0.0), snow=0.5)
    held.set_outdoors(loads)
    held.set_young(2.0 * held.young)
    try:
        teller.ask(question, held)
        with pytest.raises(InputError, match="One request"):
            teller.ask(question, held)
        assert said.over.wait(120)
        said.over.clear()
        teller.ask(protocol.parse_command(_GUSTY), held)
        assert said.over.wait(120)
    finally:
        teller.close()
    reply, gusty = said.lines
    branch = Branch.open(with_axes)
    model = load_branch(branch).model
    _, told = load_effects(
        LoadedOutdoors(model.with_young(2.0 * model.young), load_skeleton(branch), loads),
        strain_limit=0.01, deviation=None, most=50.0)
    assert (reply["event"], reply["id"], reply["command"]) == ("reply", 7, "effects")
    for name in ("sag_m", "greatest_strain", "bears_times"):
        assert reply[name] == pytest.approx(told[name], rel=1e-6), name
    assert reply["held_by"] == told["held_by"] and reply["sag_interval_m"] is None
    # An even wind of the record's own speed, blowing the way that the session's does.
    loads = replace(loads, wind=(6.0, 0.0, 0.0))
    _, told = load_effects(
        LoadedOutdoors(model.with_young(2.0 * model.young), load_skeleton(branch), loads),
        strain_limit=0.01, deviation=None)
    assert reply["gusts"] is None and gusty["gusts"]["factor"] == pytest.approx(1.0)
    assert gusty["sag_m"] == pytest.approx(told["sag_m"], rel=1e-6)
    held.set_gravity(False)
    with pytest.raises(InputError, match="switched off"):
        held.outdoors()


def test_what_cannot_be_told_is_an_error(tmp_path):
    """The reason goes to who asked, whatever it is; a session that ends says nothing."""
    question = protocol.parse_command(b'{"command": "effects", "id": 7}')
    for error, told in ((WorkError("It finds no rest."), "It finds no rest."),
                        (ValueError("odd"), "ValueError: odd"), (Cancelled(), None)):
        said, asked = Said(), Future()
        asked.set_exception(error)
        EffectsTeller(tmp_path, SessionSettings(), said).tell(question, asked)
        assert [line["message"] for line in said.lines] == ([told] if told else [])
        assert all(line["event"] == "error" and line["id"] == 7 for line in said.lines)


def test_the_command_is_checked():
    read = protocol.parse_command(
        b'{"command": "outdoors", "id": 3, "wind_m_s": [1, 0, 0], '
        b'"fruit": [{"point": [0, 0, 0.1], "mass_kg": 0.2}], "cuts": [[0, 0, 0.15]]}')
    assert read.fruit[0].mass_kg == 0.2 and read.cuts == [(0.0, 0.0, 0.15)]
    for wrong in (b'{"command": "outdoors", "fruit": [{"point": [0, 0, 0.1], "mass_kg": 0}]}',
                  b'{"command": "outdoors", "wind_m_s": [1, 0]}'):
        with pytest.raises(protocol.NotUnderstood):
            protocol.parse_command(wrong)
