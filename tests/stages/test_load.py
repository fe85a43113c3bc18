"""`limber load` on the example branch."""

from pathlib import Path

import pytest

from limber.errors import InputError
from limber.stages.load import LoadSettings, load
from limber.stages.loading import load_skeleton
from limber.store import Branch

EXAMPLE = Path(__file__).parents[2] / "blend_files" / "bending_branch"


@pytest.fixture(scope="module")
def tip():
    skeleton = load_skeleton(Branch.open(EXAMPLE))
    return tuple(map(float, skeleton.nodes[skeleton.main_path()[-1]]))


def test_a_fruit_with_interval_and_limit(tip):
    """It sags within the interval of the estimate, and bears the load so many times."""
    result = load(EXAMPLE, LoadSettings(fruit=((*tip, 0.005),), limit_load=True, most=100.0))
    low, high = result["sag_interval_m"]
    assert 0 < low < result["sag_m"] < high
    slow, fast = result["first_frequency_interval_hz"]
    assert slow < result["frequencies_hz"][0] < fast
    assert result["frequencies_hz"][0] < result["frequencies_before_hz"][0]
    assert result["added_mass_kg"] == pytest.approx(0.005)
    assert result["bears_times"] > 1 and result["held_by"] in ("strain", "equilibrium")
    strains = [row["strain"] for row in result["along"]]
    assert max(strains) <= result["greatest_strain"]


def test_a_load_is_needed_and_lies_on_the_branch(tip):
    """No load, one without mass, one somewhere else: told what is wrong."""
    for settings, words in ((LoadSettings(), "No load"),
                            (LoadSettings(fruit=((*tip, 0.0),)), "without mass"),
                            (LoadSettings(fruit=((9.0, 0.0, 0.0, 1.0),)), "off the branch")):
        with pytest.raises(InputError, match=words):
            load(EXAMPLE, settings)
