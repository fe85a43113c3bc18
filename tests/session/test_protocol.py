"""What a client may send: whatever it is, it is a command or is refused, in bounded memory."""

import json

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from limber.core.json_values import plain
from limber.session.protocol import (
    LINE_LIMIT,
    PROTOCOL,
    Lines,
    Move,
    NotUnderstood,
    parse_command,
)

GOOD = [
    {"command": "hello", "protocol": PROTOCOL},
    {"command": "grasp", "vertex": 3, "mode": "rigid", "radius_m": 0.02},
    {"command": "grasp", "point": [0.0, 0.1, 0.2]},
    {"command": "release"}, {"command": "release", "grasp": 2},
    {"command": "move", "id": 5, "pose": [0, 0, 0.2, 0.0, 0.1, 0]},
    {"command": "loads", "loads": [{"vertex": 1, "force_n": [0, 0, -1]}]},
    {"command": "gravity", "on": False}, {"command": "dynamics", "on": True},
    {"command": "young", "young_pa": [1e7, 2e7]},
    {"command": "status"}, {"command": "close"},
]
VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=7) | st.dictionaries(
        st.sampled_from(["command", "id", "pose", "vertex", "loads", "force_n"]), inner),
    max_leaves=12)


@pytest.mark.parametrize("command", GOOD, ids=lambda command: command["command"])
def test_every_command_is_understood(command):
    """What the documentation says may be sent, may."""
    assert parse_command(json.dumps(command).encode()).command == command["command"]


@pytest.mark.parametrize(("line", "words"), [
    (b'{"command": "move", "id": 1e400, "pose": [0, 0, 0, 0, 0, 0]}', "integer"),
    (b'{"command": "move", "id": ' + b"9" * 5000 + b', "pose": [0, 0, 0, 0, 0, 0]}', "JSON"),
    (b'{"command": "move", "pose": [NaN, 0, 0, 0, 0, 0]}', "finite"),
    (b'{"command": "move", "pose": [1e300, 0, 0, 0, 0, 0]}', "1000"),
    (b'{"command": "move", "pose": [0, 0, 0, 0, 0, 0], "id": true}', "integer"),
    (b"[" * 100_000, "JSON"),
    (b"\xff\xfe\x00", "JSON"),
    (b"{}", "command"),
    (b'{"command": ["move"]}', "move"),
    (b'{"command": "grasp"}', "either"),
    (b'{"command": "grasp", "vertex": 1, "point": [0, 0, 0]}', "either"),
    (b'{"command": "young", "young_pa": [0]}', "greater than 0"),
    (b'{"command": "close", "more": 1}', "more"),
])
def test_what_is_no_command_is_refused_with_its_reason(line, words):
    """One error type, whatever is wrong: numbers too large, JSON too deep, no text, no field."""
    with pytest.raises(NotUnderstood, match=words):
        parse_command(line)


@pytest.mark.slow
@given(st.sampled_from(GOOD), st.sampled_from(["command", "id", "pose", "grasp", "on", "loads"]),
       VALUES)
@settings(max_examples=300, deadline=None)
def test_a_mutated_command_is_a_command_or_is_refused(command, name, value):
    """No value anywhere raises anything else, and an error carries the id where there is one."""
    line = json.dumps(command | {name: value}).encode()
    try:
        parsed = parse_command(line)
    except NotUnderstood as error:
        assert 0 <= error.reply_id <= 2**53
        assert len(str(error)) < 2000
    else:
        assert 0 <= parsed.id <= 2**53
        if isinstance(parsed, Move):
            assert len(parsed.pose) == 6 and all(abs(x) <= 1e6 for x in parsed.pose)


@given(st.binary(max_size=400))
@settings(max_examples=300, deadline=None)
def test_bytes_of_any_kind_are_refused(line):
    """A line of noise is an error and nothing worse."""
    with pytest.raises(NotUnderstood):
        parse_command(line)


@pytest.mark.slow
@given(st.lists(st.binary(max_size=30), max_size=12), st.data())
@settings(max_examples=200, deadline=None)
def test_lines_do_not_depend_on_how_they_are_cut(lines, data):
    """Pieces of any size give the lines that were sent; those over the limit give None."""
    lines = [line.replace(b"\n", b"") for line in lines]
    stream, limit = b"".join(line + b"\n" for line in lines), 20
    reader, found = Lines(limit), []
    while stream:
        size = data.draw(st.integers(1, len(stream)))
        found += reader.feed(stream[:size])
        stream = stream[size:]
    assert found == [line if len(line) <= limit else None for line in lines]


def test_a_line_without_an_end_takes_no_memory():
    """128 MB without a newline is dropped as it comes; the next line is read again."""
    reader = Lines()
    piece = b"x" * (1 << 16)
    for _ in range(1 << 11):
        assert list(reader.feed(piece)) == []
        assert len(reader._part) <= LINE_LIMIT
    assert list(reader.feed(b'\n{"command": "close"}\n')) == [None, b'{"command": "close"}']


def test_what_is_not_finite_becomes_null():
    """Events are JSON for every reader: NaN and infinity are not."""
    import numpy as np

    line = plain({"a": np.array([1.0, np.nan]), "b": [np.inf, {"c": np.float32(2)}]})
    assert json.dumps(line, allow_nan=False) == '{"a": [1.0, null], "b": [null, {"c": 2.0}]}'
