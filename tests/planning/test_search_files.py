"""What a plan's search leaves beside it: the bound comes back as it was, whole between cells."""

import numpy as np

from limber.planning.search_files import BoundGrid, CostToGo


def test_a_bound_is_kept_and_read_between_its_cells(tmp_path):
    """Linear costs are linear between centres, in the turned grid; an unknown cell takes its
    neighbour's; nothing is known outside."""
    axes = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    costs = np.tile(np.arange(4.0)[:, None, None], (1, 3, 3))
    costs[2, 1, 1] = np.nan
    file = tmp_path / "bound.npz"
    corner = np.array([1.0, 2.0, 3.0])
    CostToGo(axes, (BoundGrid(corner, np.full(3, 0.5), costs, np.isfinite(costs)),)).write(
        file)
    found = CostToGo.read(file)
    np.testing.assert_array_equal(found.grids[0].costs, costs)
    points = corner + 0.5 * np.array([[1.5, 0.5, 0.5], [1.25, 0.5, 1.0], [2.5, 1.5, 1.5],
                                            [9.0, 0.5, 0.5]]) @ axes
    np.testing.assert_allclose(found.at(points)[:2], [1.0, 0.75])
    assert found.at(points)[2] in (1.0, 2.0, 3.0) and np.isnan(found.at(points)[3])


def test_the_largest_bound_of_all_grids_counts_where_it_is_known(tmp_path):
    """A finer grid about a part only: its bound there, the first one's elsewhere and where that is
    larger."""
    coarse = BoundGrid(np.zeros(3), np.full(3, 0.1), np.full((4, 4, 4), 0.2),
                       np.ones((4, 4, 4), bool))
    tube, known = np.full((4, 8, 8), np.nan, np.float32), np.zeros((4, 8, 8), bool)
    tube[:, 3:6, 3:6], tube[:, 6:8, 3:6] = 0.7, 0.1
    known[:, 4, 4] = known[:, 7, 4] = True
    fine = BoundGrid(np.zeros(3), np.array([0.1, 0.05, 0.05]), tube, known)
    CostToGo(np.eye(3), (coarse, fine)).write(tmp_path / "bound.npz")
    places = np.array([[0.15, 0.225, 0.225], [0.15, 0.375, 0.225], [0.15, 0.1, 0.1]])
    found = CostToGo.read(tmp_path / "bound.npz").at(places)
    np.testing.assert_allclose(found, [0.7, 0.2, 0.2], rtol=1e-6)
