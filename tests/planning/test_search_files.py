"""What a plan's search leaves beside it: the bound comes back as it was, whole between cells."""

import numpy as np

from limber.planning.search_files import CostToGo


def test_a_bound_is_kept_and_read_between_its_cells(tmp_path):
    """Linear costs are linear between centres, in the turned grid; an unknown cell takes its
    neighbour's; nothing is known outside."""
    axes = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    costs = np.tile(np.arange(4.0)[:, None, None], (1, 3, 3))
    costs[2, 1, 1] = np.nan
    file = tmp_path / "bound.npz"
    CostToGo(np.array([1.0, 2.0, 3.0]), axes, 0.5, costs).write(file)
    found = CostToGo.read(file)
    np.testing.assert_array_equal(found.costs, costs)
    points = found.origin + 0.5 * np.array([[0.5, 0.5, 0.5], [1.25, 0.5, 1.0], [2.5, 1.5, 1.5],
                                            [9.0, 0.5, 0.5]]) @ axes
    np.testing.assert_allclose(found.at(points)[:2], [0.0, 0.75])
    assert found.at(points)[2] in (1.0, 2.0, 3.0) and np.isnan(found.at(points)[3])
