"""What the benches' witness of the machine's stand-stills makes of what it saw."""

import pytest

from benchmarks.machine_stalls import Voided, Witness


@pytest.fixture
def witness(monkeypatch):
    """One that watches nothing, and has seen two processors stand still for a while."""
    monkeypatch.setattr("benchmarks.machine_stalls._processors", list)
    witness = Witness()
    witness._seen = [[(1.002, 0.002), (1.008, 0.003), (5.0, 0.2)], [(1.004, 0.004)]]
    yield witness
    witness.close()


def test_pieces_add_up_on_one_processor_and_count_within_their_time(witness):
    assert witness.lost(0.9, 1.1) == pytest.approx(0.005)
    assert witness.lost(1.001, 1.006) == pytest.approx(0.003)
    assert witness.lost(2.0, 3.0) == 0.0
    assert witness.longest(2.0) == 0.2 and witness.longest(6.0) == 0.0


def test_pieces_that_follow_each_other_are_one_stand_still(witness):
    """A host that takes 4 ms of every 6 keeps a processor for 40 ms of 60, not for 4."""
    witness._seen = [[(7.0 + 0.006 * k, 0.004) for k in range(20)], [(7.0, 0.01)]]
    assert witness.longest(6.0) == pytest.approx(0.04, abs=1e-6)
    assert witness.longest(7.11) == pytest.approx(0.04, abs=1e-6)
    witness._seen = [[(7.0 + 0.1 * k, 0.004) for k in range(20)]]
    assert witness.longest(6.0) == pytest.approx(0.004)


def test_a_stop_is_done_again_only_where_the_machine_was_away_for_as_long(witness, capsys):
    voided = Voided(witness)
    assert not voided.explains(0.9, 1.1, 0.006, "stop") and voided.count == 0
    assert voided.explains(0.9, 1.1, 0.004, "stop") and voided.count == 1
    assert "4.0 ms late where the machine stood still for 5.0 ms" in capsys.readouterr().out


def test_a_pause_long_before_a_failure_explains_nothing(witness, monkeypatch):
    def fails():
        raise AssertionError("it failed")
    monkeypatch.setattr("benchmarks.machine_stalls.time.monotonic", iter([0.0, 20.0]).__next__)
    with pytest.raises(AssertionError):
        Voided(witness).again(fails, "a loop")
    moments = iter([0.0, 8.0, 0.0, 40.0])
    monkeypatch.setattr("benchmarks.machine_stalls.time.monotonic", moments.__next__)
    voided = Voided(witness)
    with pytest.raises(AssertionError):
        voided.again(fails, "a loop")
    assert voided.count == 1
