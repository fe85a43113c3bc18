"""The check of values from files: no Boolean is taken for a number, refusals in plain words."""

from typing import Literal

import numpy as np
import pytest
from pydantic import BaseModel, Field, ValidationError

from limber.core.alignment import Alignment
from limber.core.errors import InputError
from limber.core.json_values import number_array, refusal_of, validated
from limber.core.settings import Settings, checked_settings


class _Part(BaseModel):
    size: int = 3
    start: tuple[float, float] | None = Field(None, alias="from")
    on: bool = False
    kind: Literal["a", "b"] = "a"


class _Whole(BaseModel):
    parts: list[_Part] = []
    named: dict[str, _Part] = {}
    either: bool | float = 1.0


@pytest.mark.parametrize(("content", "place"), [
    ({"parts": [{}, {"size": True}]}, ("parts", 1, "size")),
    ({"parts": [{"from": [0.0, False]}]}, ("parts", 0, "from", 1)),
    ({"named": {"x": {"size": False}}}, ("named", "x", "size"))])
def test_a_boolean_is_no_number(content, place):
    """At any depth, by alias too; its place is named."""
    with pytest.raises(ValidationError) as refused:
        validated(_Whole, content)
    assert refused.value.errors()[0]["loc"] == place


def test_what_is_meant_is_read():
    """Booleans where they belong, whole numbers with a point, numbers as text on a command line."""
    made = validated(_Whole, {"parts": [{"on": True, "size": 4.0, "from": [1, 2]}], "either": True})
    assert made.parts[0].size == 4 and made.parts[0].on is True and made.either is True
    assert validated(list[float], (1, "2.5")) == [1.0, 2.5]


def test_a_setting_takes_no_boolean_for_a_number():
    """As from Python or a job file: seed = true."""
    class Made(Settings):
        seed: int = 0

    with pytest.raises(InputError, match="--seed True: it must be a number"):
        checked_settings(Made, {"seed": True})


@pytest.mark.parametrize("values", [[True, 1.0], ["1"], [[1.0], [1.0, 2.0]], [None], 1j])
def test_lists_of_anything_but_numbers(values):
    """Refused; numpy by itself takes the first two for numbers."""
    with pytest.raises(ValueError, match=r"number|shape"):
        number_array(values)


def test_lists_of_numbers():
    """Of any shape, whole ones among them."""
    np.testing.assert_array_equal(number_array([[1, 2.5], [3, 4]]), [[1.0, 2.5], [3.0, 4.0]])
    assert number_array([]).shape == (0,)


@pytest.mark.parametrize("content", [{"scale": 1e-300}, {"scale": True}, {"origin": [0, 0, 1e15]}])
def test_an_alignment_of_no_scan(content):
    """It could not be undone: its matrix would have no inverse."""
    with pytest.raises(ValidationError):
        validated(Alignment, content)
    assert validated(Alignment, {"scale": 1e-6, "origin": [4e5, 5.8e6, 0]}).scale == 1e-6


@pytest.mark.parametrize(("content", "said"), [
    ({"kind": "c"}, "it must be a or b, not 'c'"), ({"kind": 3}, "it must be a or b, not '3'"),
    ({"sizes": [1]}, "it is missing"), ({"sizes": [1, 2, 3]}, "it has 3 parts, not 2"),
    ({"sizes": 1}, "it must be a list"), ({"count": 1.5}, "it must be a whole number"),
    ({"count": "many"}, "it must be a whole number"), ({"count": 0}, "it must be greater than 0"),
    ({"part": 3}, "it must be a table of entries"), ({"other": 1}, "no such entry is known")])
def test_a_refused_value_is_told_in_plain_words(content, said):
    """Its checker speaks of inputs, tags and dictionaries."""
    class Refused(BaseModel, extra="forbid"):
        kind: Literal["a", "b"] = "a"
        sizes: tuple[float, float] = (0.0, 0.0)
        count: int = Field(1, gt=0)
        part: _Part | None = None

    with pytest.raises(ValidationError) as refused:
        validated(Refused, content)
    assert refusal_of(refused.value.errors()[0]) == said
