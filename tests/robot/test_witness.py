"""What the benches' witness of the machine's stand-stills makes of what it saw."""

import pytest

from benchmarks.held_up import Voided, Witness


@pytest.fixture
def witness(monkeypatch):
    """One that watches nothing, and has seen two processors stand still for a while."""
    monkeypatch.setattr("benchmarks.held_up._processors", list)
    witness = Witness()
    witness._seen = [[(1.002, 0.002), (1.008, 0.003), (5.0, 0.2)], [(1.004, 0.004)]]
    yield witness
    witness.close()


def test_pieces_add_up_on_one_processor_and_count_within_their_time(witness):
    assert witness.lost(0.9, 1.1) == pytest.approx(0.005)
    assert witness.lost(1.001, 1.006) == pytest.approx(0.003)
    assert witness.lost(2.0, 3.0) == 0.0
    assert witness.longest(2.0) == 0.2 and witness.longest(6.0) == 0.0


def test_a_stop_is_done_again_only_where_the_machine_was_away_for_as_long(witness, capsys):
    voided = Voided(witness)
    assert not voided.explains(0.9, 1.1, 0.006, "stop") and voided.count == 0
    assert voided.explains(0.9, 1.1, 0.004, "stop") and voided.count == 1
    assert "4.0 ms late where the machine stood still for 5.0 ms" in capsys.readouterr().out
