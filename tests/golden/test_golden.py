"""The stages' results, files and messages, and those of wrong commands, are as they were.

What shall change is written anew by `scripts/make_golden`, and git shows it. The schemas of the
stages stand in addon/stages.json, which tests/addon/test_stages.py holds to them.
"""

import json
import math

import pytest
from tests.golden.references import ALL, HERE, NUMBER, written

CLOSE = {"compare": 1e-2, "plan": 1e-2, "plan-limits": 1e-2, "estimate": 1e-3, "swing": 1e-4,
         "suggest-pull": 1e-3, "vibration": 1e-5, "errors": 1e-2, "execute": 1e-2}
"""Relative tolerance of numbers: searches amplify the last digits, which differ by processor."""
PRINTED = 0.02
"""That of numbers in texts, which have few digits."""


def differences(kept, found, tolerance: float, scale: float = 0.0, place: str = "") -> list[str]:
    """Where two references differ; ``scale`` is the greatest number of the list around."""
    if isinstance(kept, dict) and isinstance(found, dict):
        return [line for name in kept | found for line in differences(
            kept.get(name), found.get(name), tolerance, place=f"{place}/{name}")]
    if isinstance(kept, list) and isinstance(found, list) and len(kept) == len(found):
        scale = max((abs(each) for each in kept if isinstance(each, int | float)), default=0.0)
        return [line for number, (one, other) in enumerate(zip(kept, found, strict=True))
                for line in differences(one, other, tolerance, scale, f"{place}/{number}")]
    if isinstance(kept, float | int) and isinstance(found, float | int):
        scale = 100.0 if "percent" in place.rpartition("/")[2] else scale
        same = math.isclose(kept, found, rel_tol=tolerance, abs_tol=tolerance * scale + 1e-12)
    elif isinstance(kept, str) and isinstance(found, str):
        words = [" ".join(NUMBER.sub("#", text).split()) for text in (kept, found)]
        numbers = [[float(each) for each in NUMBER.findall(text)] for text in (kept, found)]
        same = words[0] == words[1] and not differences(*numbers, PRINTED)
    else:
        same = kept == found
    return [] if same else [f"{place}: {kept!r} became {found!r}"]


@pytest.mark.slow
@pytest.mark.parametrize("name", ALL)
def test_nothing_changed_unnoticed(name):
    kept = json.loads((HERE / f"{name}.json").read_text(encoding="utf-8"))
    found = json.loads(written(ALL[name]()))
    assert not differences(kept, found, CLOSE.get(name.removeprefix("stages/"), 1e-6))


def test_every_stage_has_a_reference():
    """But record, which needs a robot."""
    from limber.stages.registry import stage_summaries

    commands = [json.loads(path.read_text(encoding="utf-8"))["command"].split()[0]
                for path in (HERE / "stages").glob("*.json")]
    assert set(stage_summaries()) - set(commands) == {"record"}
    assert {f"stages/{path.stem}" for path in (HERE / "stages").glob("*.json")} <= set(ALL)
