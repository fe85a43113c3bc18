"""A format of skeletons of another package: registered, it is read and written by our commands."""

from pathlib import Path

import numpy as np
import pytest

from limber.core.errors import InputError
from limber.geometry.bodies import body_format
from limber.geometry.io.formats import Format
from limber.geometry.io.skeletons import SKELETONS, read_skeleton
from limber.geometry.skeleton.skeleton import Skeleton
from limber.stages.results.export import ExportSettings, export
from limber.store import Branch
from limber.store.loading import load_skeleton

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
    told = export(EXAMPLE, tmp_path / "a.foo", ExportSettings())
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
                    lambda: export(EXAMPLE, tmp_path / "a.docx", ExportSettings())):
        with pytest.raises(InputError, match=r"\.foo .*\.swc"):
            refused()


def test_swc_of_any_suffix_is_recognised(tmp_path):
    """By its lines, as far as no format has the suffix."""
    load_skeleton(Branch.open(EXAMPLE)).write_swc(tmp_path / "a.eswc")
    assert read_skeleton(tmp_path / "a.eswc").node_count > 10
