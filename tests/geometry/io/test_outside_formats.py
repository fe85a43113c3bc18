"""Formats of other packages: registered, they are read and written wherever Limber reads."""

import json
from pathlib import Path

import numpy as np
import pytest

from limber.cli.main import call
from limber.core.errors import InputError
from limber.geometry.bodies import body_format
from limber.geometry.generated import generate_branch
from limber.geometry.io.clouds import CLOUDS, read_points
from limber.geometry.io.formats import Format, starts_with
from limber.geometry.io.skeletons import SKELETONS, read_skeleton
from limber.geometry.skeleton.skeleton import Skeleton
from limber.stages.registry import stage_class
from limber.stages.results.export import Export
from limber.store import Branch
from limber.store.loading import load_skeleton

# A format of clouds of another package: registered, it is read wherever clouds are.


class Dots:
    """Coordinates as doubles behind the word dots."""

    @staticmethod
    def write(points, path):
        path.write_bytes(b"dots" + np.asarray(points, "<f8").tobytes())

    @staticmethod
    def read(path):
        points = np.frombuffer(path.read_bytes()[4:], "<f8").reshape(-1, 3)
        return dict(zip("xyz", points.T, strict=True))


@pytest.fixture(params=[False, True], ids=["here", "isolated"])
def dots(request):
    # A stage's help lists the formats that there are when it is loaded: other tests' as well.
    stage_class("reconstruct")
    CLOUDS.register(Format("dots", (".foo",), Dots.read, recognises=starts_with(b"dots"),
                           isolated=request.param))
    yield
    del CLOUDS.formats[0]


@pytest.mark.slow
def test_it_is_read_by_suffix_and_by_content(dots, tmp_path):
    """A mangled file is refused as those of any format are."""
    points = np.random.default_rng(0).normal(size=(50, 3))
    for name in ("a.foo", "a.bar"):
        Dots.write(points, tmp_path / name)
        np.testing.assert_array_equal(read_points(tmp_path / name).points, points)
    (tmp_path / "cut.foo").write_bytes(b"dots1234")
    with pytest.raises(InputError, match=r"cut\.foo cannot be read"):
        read_points(tmp_path / "cut.foo")


def test_its_suffix_is_listed_and_its_name_is_its_own(dots, tmp_path):
    (tmp_path / "a.docx").write_bytes(b"nonsense")
    with pytest.raises(InputError, match=r"\.foo .*\.ply"):
        read_points(tmp_path / "a.docx")
    with pytest.raises(ValueError, match="dots"):
        CLOUDS.register(Format("dots", (".dots",), Dots.read))


@pytest.mark.slow
@pytest.mark.parametrize("dots", [False], indirect=True)
def test_reconstruct_takes_it(dots, tmp_path, capsys):
    """A file of it, and a folder with one among files of other kinds."""
    Dots.write(generate_branch(1, length=0.3, fork_count=0).cloud.points, tmp_path / "in.foo")
    (tmp_path / "notes.docx").write_bytes(b"nonsense")
    assert call(["reconstruct", str(tmp_path), "-o", str(tmp_path / "out"), "--json"]) == 0
    told = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert told["done_count"] == 1 and told["done"]["in.foo"]["watertight"]


# A format of skeletons of another package: registered, it is read and written by our commands.

EXAMPLE = Path(__file__).parents[3] / "blend_files" / "bending_branch"


class Rows:
    """Nodes, radius and parent as a table."""

    @staticmethod
    def write(skeleton, path):
        np.savetxt(path, np.column_stack([skeleton.nodes, skeleton.radius, skeleton.parent]))

    @staticmethod
    def read(path, *, scale):
        table = np.loadtxt(path)
        return Skeleton.from_edges(table[:, :3] * (scale or 1.0), table[:, 4].astype(int),
                                   table[:, 3] * (scale or 1.0))


@pytest.fixture
def rows():
    SKELETONS.register(Format("rows", (".foo",), Rows.read, Rows.write))
    yield SKELETONS.formats[0]
    del SKELETONS.formats[0]


def test_it_comes_back_as_it_went_out(rows, tmp_path):
    """By `limber export`; `limber mesh` takes it for the cylinder model that it is."""
    told = Export(branch_folder=EXAMPLE, output=tmp_path / "a.foo").run()
    before, after = load_skeleton(Branch.open(EXAMPLE)), read_skeleton(tmp_path / "a.foo")
    assert told["format"] == ".foo" and told["cylinder_count"] == before.node_count - 1
    np.testing.assert_array_equal(after.nodes, before.nodes)
    np.testing.assert_array_equal(after.parent, before.parent)
    np.testing.assert_array_equal(read_skeleton(tmp_path / "a.foo", scale=1e-3).radius,
                                  1e-3 * before.radius)
    assert body_format(tmp_path / "a.foo") is rows


def test_its_suffix_is_listed(rows, tmp_path):
    (tmp_path / "a.docx").write_bytes(b"nonsense")
    for refused in (lambda: read_skeleton(tmp_path / "a.docx"),
                    lambda: body_format(tmp_path / "a.docx"),
                    lambda: Export(branch_folder=EXAMPLE, output=tmp_path / "a.docx").run()):
        with pytest.raises(InputError, match=r"\.foo .*\.swc"):
            refused()


def test_swc_of_any_suffix_is_recognised(tmp_path):
    """By its lines, as far as no format has the suffix."""
    load_skeleton(Branch.open(EXAMPLE)).write_swc(tmp_path / "a.eswc")
    assert read_skeleton(tmp_path / "a.eswc").node_count > 10
