"""The scans with truth as plain files, and their score."""

import subprocess
import sys

import numpy as np
import pytest

from benchmarks.worlds import public, score
from limber.geometry.io.skeletons import read_swc
from limber.geometry.skeleton.skeleton import Skeleton


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """One scan of a kind."""
    made = tmp_path_factory.mktemp("worlds")
    public.main([str(made), "--seed", "3", "--only", "sparse_drooping_round"])
    return made


def test_a_folder_scores_any_program(folder):
    """Its own truth is right; no result counts as none. Limber is not needed."""
    name, = (path.name for path in (folder / "scans").iterdir())
    assert name == "sparse_drooping_round_3.ply"
    for results, told in (("truth", "100%    100%    +0.0%    +0.0%    +0.0%"), ("scans", "nan")):
        done = subprocess.run([sys.executable, "-I", "score.py", results], cwd=folder,
                              capture_output=True, text=True, check=True)
        line = done.stdout.splitlines()[-1]
        assert line.split()[1:3] == ["1", "01"[results == "scans"]] and told in line
    assert "limber" not in " ".join(vars(score))


def test_what_is_wrong_costs_its_own_score(folder, tmp_path):
    """Half the axis is missing, it is double as thick, or lies beside."""
    truth = folder / "truth" / "sparse_drooping_round_3.swc"
    whole = read_swc(truth)

    def of(skeleton):
        skeleton.write_swc(tmp_path / "found.swc", unit="m")
        return score.compared(truth, tmp_path / "found.swc")
    main = whole.branch == 0
    stem = of(Skeleton.from_edges(whole.nodes[main], np.arange(main.sum()) - 1, whole.radius[main]))
    assert stem["own"] == 1 and stem["found"] < 0.9 and stem["length"] < 0.9
    thick = of(Skeleton.from_edges(whole.nodes, whole.parent, 2 * whole.radius))
    assert thick["radius"] == pytest.approx(1, abs=0.02)
    assert thick["volume"] == pytest.approx(4, rel=1e-3) and thick["found"] == 1
    beside = of(whole.moved(whole.nodes + [0, 0, 10.0]))
    assert beside["found"] == beside["own"] == 0 and np.isnan(beside["radius"])
    assert beside["length"] == pytest.approx(1)
