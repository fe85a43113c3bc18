"""What the paper names stays settable: each of its equations and parameters has its option."""

from pathlib import Path

import click
import pytest

from limber.cli.main import main
from limber.stages.command_line import options_of
from limber.stages.registry import stage_schema

GUIDE = Path(__file__).parents[1] / "worker" / "docs" / "explanation" / "method.md"

PAPER = [
    # (what the paper names, command, setting, a value that it must take)
    ("equation 1: W_L and W_H", "reconstruct", "contraction_weight", 2.0),
    ("aligned upright, R and t", "reconstruct", "upright", True),
    ("radius r_i by the nearest points", "reconstruct", "radii", "paper"),
    ("k of the radii", "reconstruct", "radius_neighbours", 16),
    ("alpha and beta of the radii", "reconstruct", "radius_range", (0.001, 0.2)),
    ("gamma of a gap", "reconstruct", "gap_factor", 5.0),
    ("cross-sections of the generalised cylinders", "reconstruct", "mesh_spacing", 1.5),
    ("fTetWild", "reconstruct", "mesher", "ftetwild"),
    ("equation 2: mass M", "reconstruct", "density", 700.0),
    ("equation 2: damping D", "simulate", "damping", (1.0, 0.01)),
    ("equation 2: f_ext, gravity", "simulate", "gravity", False),
    ("equation 2: f_ext, contact", "simulate", "grasp_force", (0.0, 1.0, 0.0)),
    ("equation 2: BC, the base", "reconstruct", "root", (0.0, 0.0, 0.0)),
    ("equation 3: St. Venant-Kirchhoff", "simulate", "material", "st_venant_kirchhoff"),
    ("equation 3: lambda and mu", "reconstruct", "young", 2e8),
    ("equation 3: lambda and mu", "reconstruct", "poisson", 0.3),
    ("implicit Newmark: beta and gamma", "simulate", "newmark", (0.3, 0.6)),
    ("implicit Newmark: step", "simulate", "step", 0.001),
    ("grasp set G_t", "import-pull", "grasp_point", (0.0, 0.0, 0.3)),
    ("grasp set G_t", "import-pull", "grasp_radius", 0.02),
    ("segmentation mask", "import-pull", "yolo_prompt", "potted plant"),
    ("measured force drives", "estimate", "drive", "force"),
    ("evolution over time", "estimate", "motion", "dynamic"),
    ("control points K", "estimate", "fractions", (0.2, 0.4, 0.6, 0.8)),
    ("equation 4 and algorithm 1: Nelder-Mead", "estimate", "method", "nelder-mead"),
    ("algorithm 1: initial E_k", "reconstruct", "young", 1e8),
    ("algorithm 1: initial nu", "reconstruct", "poisson", 0.38),
    ("algorithm 1: nu in theta", "estimate", "also", ("poisson",)),
    ("inverse-distance weighting", "estimate", "field", "inverse_distance"),
    ("equation 5: alpha_def and alpha_dis", "plan", "weights", (2.0, 0.5)),
    ("D-RRT*", "plan", "planner", "d-rrt-star"),
    ("goals in the hemisphere", "plan", "goal_seed", 4),
    ("random initial configurations", "plan", "start_seed", 4),
    ("bounds on contact force", "plan", "max_force", 2.0),
    ("bounds on deformation", "plan", "max_strain", 0.02),
    ("sampled grasp points of the RBF", "energy", "samples", 100),
    ("10 trials", "compare", "trials", 20),
]
TOGETHER = [("algorithm 1: delta", "estimate", {"method": "nelder-mead", "delta_m2": 1e-5})]


@pytest.mark.parametrize(("what", "stage", "values"), [
    *((what, stage, {name: value}) for what, stage, name, value in PAPER), *TOGETHER])
def test_it_has_an_option_and_a_row_in_the_guide(what, stage, values):
    from limber.stages.registry import stage_class

    described = stage_class(stage)
    command = main.get_command(click.Context(main), stage)
    page = GUIDE.read_text(encoding="utf-8").split("## Equations and options")[1]
    for name in values:
        part = next(part for part, names in described.parts().items() if name in names)
        assert name in stage_schema(stage)[part]["properties"]
        flag = f"--{name.replace('_', '-')}"
        assert flag in options_of(command), what
        row = next((line for line in page.splitlines() if f"`{stage}`" in line and flag in line),
                   None)
        assert row is not None, f"{what}: no row of {stage} {flag}"
    needed = {name: "some" for name, field in described.model_fields.items() if field.is_required()}
    made = described.checked(needed | values)
    assert {name: getattr(made, name) for name in values} == values
