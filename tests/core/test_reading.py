"""The door for files of others: what is not finite, too deep, too large or no number stays out."""

import errno
import io
import os
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest

from limber.batch.job_file import toml_lines
from limber.core.errors import InputError, WorkError
from limber.core.files import reading
from limber.core.files.atomic import file_digest, replacing, require_file
from limber.core.files.reading import (
    MOST_TOML_BYTES,
    read_arrays,
    read_json,
    read_json_as,
    read_text,
    read_toml,
    require_shapes,
    toml_content,
)
from limber.core.files.tables import csv_records, read_columns
from limber.core.machine_errors import machine_error
from limber.geometry.io.clouds import read_points
from limber.geometry.io.skeletons import read_skeleton
from limber.recordings.tables import text_of


@pytest.mark.parametrize("text", [
    "NaN", "[Infinity]", "[1e400]", "[-1e30]", "[" + "9" * 50 + "]", "{", "[" * 100_000,
    '{"a": ' + "9" * 400 + "}", "\xff", r'["\uD83C"]', r'{"\udf3f": 1}'])
def test_json_that_is_refused(tmp_path, text):
    """Numbers that are not finite, endless nesting, endless digits, no text, half a character: one
    clear error."""
    path = tmp_path / "a.json"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(InputError, match=r"a\.json"):
        read_json(path, "numbers")


def test_json_of_a_kind_says_where(tmp_path):
    """The place that is wrong is named; what fits comes as it is."""
    path = tmp_path / "a.json"
    path.write_text("[1, 2.5]")
    assert read_json_as(path, list[float], "numbers") == [1.0, 2.5]
    path.write_text('[1, "x"]')
    with pytest.raises(InputError, match="1: it must be a number"):
        read_json_as(path, list[float], "numbers")


@pytest.mark.parametrize("text", ["a = 1e400", "a = -1e30", "a = ", "a = [" * 3000])
def test_toml_that_is_refused(tmp_path, text):
    """Likewise; TOML's own inf and nan too."""
    path = tmp_path / "a.toml"
    path.write_text(text)
    with pytest.raises(InputError, match=r"a\.toml"):
        read_toml(path, "settings")
    path.write_text("a = nan")
    with pytest.raises(InputError):
        read_toml(path, "settings")


@pytest.mark.parametrize("key", [
    ".".join(["a"] * 60_000), "[" + " . ".join(["a", "'b c'", '"d.e"'] * 20) + "]",
    "x = {" + ".".join(["a-1"] * 40) + " = 1}"])
def test_endless_keys_are_refused_before_they_are_parsed(tmp_path, monkeypatch, key):
    """The parser would take 21 s and 5.8 GB for the first; depth is counted before it begins."""
    path = tmp_path / "a.toml"
    path.write_text(f"b = 1\n{key} = 1\n")
    monkeypatch.setattr(reading.tomllib, "loads", lambda *_, **__: pytest.fail("it was parsed"))
    with pytest.raises(InputError, match=r"a\.toml.*line 2: a key has more than 32 parts"):
        read_toml(path, "settings")


def test_what_only_looks_like_a_long_key_is_read(tmp_path):
    """Rows of numbers, texts with dots, and keys of some parts."""
    path = tmp_path / "a.toml"
    text = f"a = [{', '.join(['0.25'] * 100)}]\nb = '{'x. ' * 30}'\nc.d.'e.f' = 1\n"
    path.write_text(text)
    assert read_toml(path, "settings") == {"a": [0.25] * 100, "b": "x. " * 30,
                                           "c": {"d": {"e.f": 1}}}


def test_a_toml_file_has_a_size(tmp_path):
    """Also a text that came in a bag."""
    path = tmp_path / "a.toml"
    path.write_text("#" * (MOST_TOML_BYTES + 1))
    with pytest.raises(InputError, match="at most 2 MB"):
        read_toml(path, "settings")
    with pytest.raises(InputError, match="2097153 characters"):
        toml_content(path.read_text(), path, "settings")


def test_lines_of_toml_are_found_behind_a_million_blanks():
    """A line of blanks in a text of several lines looks like the start of a table. A search that
    looks at the blanks again from each of them would not end within a test's limit."""
    lines = toml_lines("x = '''\n[" + " " * 1_000_000 + "\n'''\n[ a . b ]\n c = 1")
    assert lines[("a", "b", "c")] == 5


def test_a_long_field_of_a_table_is_refused(tmp_path):
    """Python's reader takes 131,072 characters at most, and raises an error of its own."""
    path = tmp_path / "a.csv"
    path.write_text("a,b\n" + "x" * 140_000 + ",1\n")
    for read in (lambda: read_columns(path, ("b",), "numbers"), lambda: csv_records(path, "rows")):
        with pytest.raises(InputError, match=r"a\.csv.*field"):
            read()


@pytest.mark.parametrize("name", ["a.xyz", "a.ptx", "a.swc", "a.mtg", "a.csv", "pull.csv"])
def test_zeros_without_end_are_refused_at_once(name, tmp_path):
    """A disk that was full, or a sparse file: one line of gigabytes, of which none is read."""
    path = tmp_path / name
    path.touch()
    os.truncate(path, 4 << 30)
    read = text_of if name == "pull.csv" else (
        read_skeleton if name in ("a.swc", "a.mtg", "a.csv") else read_points)
    with pytest.raises(InputError, match=rf"{name} (is not a text file|has 4295 MB)"):
        read(path)
    path.write_bytes(b"1 2 3\n" + bytes(9))
    with pytest.raises(InputError, match="zero bytes"):
        read(path)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="Windows has no named pipes")
def test_pipes_and_devices_are_refused(tmp_path):
    """Nobody writes to this pipe: to open it would wait for ever. A device has no end."""
    pipe = tmp_path / "cloud.ply"
    os.mkfifo(pipe)
    for place in (pipe, "/dev/zero"):
        for read in (lambda p: read_text(p, "text"), lambda p: read_json(p, "numbers"), file_digest,
                     lambda p: read_arrays(p, "arrays"), lambda p: require_file(p, "A scan")):
            with pytest.raises(InputError, match="is a pipe or a device"):
                read(place)


def test_a_file_is_replaced_whole_or_not_at_all(tmp_path):
    """An error in the middle leaves the old content and no litter; a device stays a device."""
    path = tmp_path / "a.bin"
    path.write_bytes(b"old")
    with pytest.raises(OSError, match="full"), replacing(path) as stream:
        stream.write(b"half")
        raise OSError(errno.ENOSPC, "full")
    assert path.read_bytes() == b"old" and list(tmp_path.iterdir()) == [path]
    with replacing(path) as stream:
        stream.write(b"new")
    assert path.read_bytes() == b"new"
    with pytest.raises(InputError, match="is a pipe or a device"), replacing(Path(os.devnull)):
        pytest.fail("it was opened")


@pytest.mark.parametrize(("code", "kind"), [
    (errno.ENAMETOOLONG, InputError), (errno.EISDIR, InputError), (errno.EFBIG, WorkError),
    (errno.EMFILE, WorkError), (errno.ENOSPC, WorkError), (errno.EROFS, InputError)])
def test_what_the_system_refuses_is_told(code, kind):
    """Each with the file, what it means and what to do."""
    told = machine_error(OSError(code, os.strerror(code), "x.ply"))
    assert type(told) is kind and "x.ply" in told.seen and told.why and told.fix


def test_arrays_come_as_they_were_saved(tmp_path):
    """Both orders, no dimensions, none at all, and text."""
    arrays = {"a": np.arange(6.0).reshape(2, 3), "b": np.asfortranarray(np.arange(6).reshape(2, 3)),
              "c": np.array(2.5), "d": np.empty((0, 3)), "e": np.array(["x", "yz"])}
    np.savez_compressed(tmp_path / "a.npz", **arrays)
    np.save(tmp_path / "a.npy", arrays["b"])
    found = read_arrays(tmp_path / "a.npz", "arrays")
    assert set(found) == set(arrays)
    for name, values in arrays.items():
        np.testing.assert_array_equal(found[name], values)
        assert found[name].dtype == values.dtype
    np.testing.assert_array_equal(read_arrays(tmp_path / "a.npy", "an array")["arr_0"], arrays["b"])


def _npy_header(shape: str) -> bytes:
    text = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text.encode()


@pytest.mark.parametrize("shape", ["(1000000000000,)", "(-3,)", "(99999, 99999, 99999)"])
def test_an_array_that_announces_more_than_there_is(tmp_path, shape):
    """Refused by its header: no memory is asked for."""
    (tmp_path / "a.npy").write_bytes(_npy_header(shape) + bytes(24))
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("a.npy", _npy_header(shape) + bytes(24))
    for name in ("a.npy", "a.npz"):
        with pytest.raises(InputError, match="announced"):
            read_arrays(tmp_path / name, "arrays")


def test_a_header_that_is_no_header(tmp_path):
    """One that Python's own parser of words gives up on."""
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': ((3,"
    path = tmp_path / "a.npy"
    path.write_bytes(np.lib.format.magic(1, 0) + struct.pack("<H", len(header)) + header)
    with pytest.raises(InputError, match=r"a\.npy"):
        read_arrays(path, "numbers")


@pytest.mark.slow
def test_an_archive_that_would_flood_the_memory(tmp_path):
    """A megabyte that expands to a gigabyte is refused before it does."""
    with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        with archive.open("a.npy", "w", force_zip64=True) as member:
            for _ in range(300):
                member.write(bytes(1 << 20))
    with pytest.raises(InputError, match="expand"):
        read_arrays(tmp_path / "a.npz", "arrays")


def test_objects_are_never_loaded(tmp_path):
    """Pickled content is told, not run."""
    np.savez(tmp_path / "a.npz", a=np.array([{}], object))
    with pytest.raises(InputError, match="objects"):
        read_arrays(tmp_path / "a.npz", "arrays")


def test_shapes_that_do_not_fit(tmp_path):
    """Missing, of other length, text, Booleans, not finite, or too large: each is named."""
    good = {"a": np.zeros((4, 3)), "b": np.zeros(4)}
    shapes = {"a": ("n", 3), "b": ("n",)}
    require_shapes(tmp_path, good, shapes, "arrays")
    for bad in ({"a": good["a"]}, {**good, "b": np.zeros(5)}, {**good, "b": np.array(["x"] * 4)},
                {**good, "b": np.zeros(4, bool)}, {**good, "b": np.array([0, 0, np.inf, 0])},
                {**good, "b": np.array([0, 0, -1e30, 0])},
                {**good, "b": np.array([0, 0, 1e30, 0], np.float32)}):
        with pytest.raises(InputError, match="b"):
            require_shapes(tmp_path, bad, shapes, "arrays")
    require_shapes(tmp_path, {**good, "b": np.zeros(4, bool)}, shapes, "arrays", flags=("b",))


def test_columns_of_numbers(tmp_path):
    """A column with a gap or a word is none; one that is needed is missed by name."""
    path = tmp_path / "a.csv"
    path.write_text("x,y,word\n1,2,a\n3,nan,b\n")
    assert list(read_columns(path, ["x"], "a table")) == ["x"]
    with pytest.raises(InputError, match="column y"):
        read_columns(path, ["x", "y"], "a table")
    path.write_text("x\n1\n1e300\n")
    with pytest.raises(InputError, match="column x"):
        read_columns(path, ["x"], "a table")


def test_bytes_that_are_no_archive():
    """What is no zip at all reads as damaged, whatever numpy would say."""
    with pytest.raises(InputError):
        read_arrays(__file__, "arrays")
    assert zipfile.is_zipfile(io.BytesIO(b"")) is False
