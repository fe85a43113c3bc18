"""Bodies given without a scan: drawn sections and cylinder models become sound meshes."""

from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import cumulative_trapezoid, trapezoid
from tests.stages.specified import Fit

from limber.cli.main import call
from limber.core.constants import STANDARD_GRAVITY
from limber.core.errors import InputError
from limber.geometry.bodies import body_format, mesh_model, mesh_sections, read_sections
from limber.geometry.io.skeletons import SKELETONS, read_skeleton
from limber.geometry.settings import MeshSurfaceSettings
from limber.mechanics.added_masses import PointMass
from limber.mechanics.model import BranchModel
from limber.mechanics.points import point_operator
from limber.mechanics.statics.solve import solve_static
from limber.recordings.time_series import Stream, write_stream
from limber.stages.pulls.import_pull import ImportPull
from limber.stages.results.export import Export
from limber.stages.shape.mesh import Mesh
from limber.store import Branch
from limber.store.loading import load_branch, load_mesh, load_point_masses, load_skeleton

# A body drawn as sections: its mesh, and Young's modulus from how it sags.

LENGTH, YOUNG, DENSITY, HUNG = 0.5, 4e8, 800.0, 0.03
WIDTH, HEIGHT = (0.024, 0.012), (0.014, 0.010)
SETTINGS = MeshSurfaceSettings(upright=False, density=DENSITY)


def table(path, *, columns="x_mm,y_mm,z_mm,width_mm,height_mm,mass_kg"):
    """A level beam along x, wider than high, thinner outwards, with 30 g at its tip."""
    rows = [[1e3 * LENGTH * share, 0.0, 0.0, *(1e3 * (a + share * (b - a)) for a, b in (
        WIDTH, HEIGHT)), HUNG * (share == 1)] for share in (0.0, 0.25, 0.5, 0.75, 1.0)]
    path.write_text("\n".join([columns, *(",".join(map(str, row)) for row in rows)]) + "\n",
                    encoding="utf-8")
    return path


def slender_sag(on_edge):
    """Drop of the tip [m] by Euler and Bernoulli, section by section."""
    x = np.linspace(0.0, LENGTH, 2001)
    width, height = (a + x / LENGTH * (b - a) for a, b in (WIDTH, HEIGHT))
    deep, wide = (width, height) if on_edge else (height, width)
    weight = STANDARD_GRAVITY * DENSITY * np.pi / 4 * width * height
    beyond = trapezoid(weight, x) - cumulative_trapezoid(weight, x, initial=0)
    shear = beyond + HUNG * STANDARD_GRAVITY
    moment = trapezoid(shear, x) - cumulative_trapezoid(shear, x, initial=0)
    slope = cumulative_trapezoid(moment / (YOUNG * np.pi / 64 * wide * deep**3), x, initial=0)
    return float(trapezoid(slope, x))


@pytest.mark.parametrize("on_edge", [False, True])
def test_drawn_ellipses_sag_as_slender_beams_do(tmp_path, on_edge):
    """On the flat and on edge, under a small part of its weight: within 1 % of beam theory."""
    body, masses = mesh_sections(read_sections(table(tmp_path / "beam.csv"), "m"), SETTINGS)
    small, down = 1e-3, -np.eye(3)[1 if on_edge else 2]
    gravity = small * STANDARD_GRAVITY * (np.array(body.alignment.rotation) @ down)
    model = BranchModel(body.mesh, young=YOUNG, poisson=0.3, density=DENSITY, gravity=gravity,
                        point_masses=[PointMass(tuple(m["attached_m"]), m["mass_kg"])
                                      for m in masses])
    moved = point_operator(body.mesh, body.skeleton.nodes[-1:]) @ solve_static(
        model).require().displacement.ravel()
    drop = float(moved @ gravity / np.linalg.norm(gravity)) / small
    assert drop == pytest.approx(slender_sag(on_edge), rel=0.01)
    assert body.mesh.volumes.sum() == pytest.approx(body.surface.volume, rel=1e-9)


@pytest.mark.slow
def test_own_sag_gives_the_modulus(tmp_path):
    """Held up first, then sagging under its own weight and the 30 g: E within 2 %, covered."""
    path = table(tmp_path / "beam.csv")
    branch = tmp_path / "beam.branch"
    Mesh.of(SETTINGS, surface=path, output=branch).run()
    assert sum(mass.mass for mass in load_point_masses(Branch.open(branch))) == HUNG
    fine, masses = mesh_sections(read_sections(path, "m"), SETTINGS, elements_across=4.5)
    model = BranchModel(fine.mesh, young=YOUNG, poisson=0.35, density=DENSITY,
                        gravity=fine.numbers["gravity_m_s2"], point_masses=[
                            PointMass(tuple(m["attached_m"]), m["mass_kg"]) for m in masses])
    places = fine.skeleton.nodes[1:]
    moved = (point_operator(fine.mesh, places) @ solve_static(
        model).require().displacement.ravel()).reshape(-1, 3)
    times = np.arange(200) / 100
    part = np.where(times > 0.3, 1 - np.exp(-30 * np.maximum(times - 0.3, 0)), 0.0)
    seen = places + part[:, None, None] * moved + 5e-5 * np.random.default_rng(2).standard_normal(
        (200, *moved.shape))
    write_stream(tmp_path / "sag.csv", Stream(times, seen.reshape(200, -1), tuple(
        f"m{k}_{axis}_m" for k in range(len(places)) for axis in "xyz")))
    ImportPull(branch_folder=branch, source=tmp_path / "sag.csv", name="sag", weight=0,
               own_weight=True).run()
    found = Fit(branch_folder=branch, fractions=(0.5,), density_sigma=0.01).run()
    low, high = found["young_interval_pa"][0]
    assert found["young_pa"][0] == pytest.approx(YOUNG, rel=0.02)
    assert low < YOUNG < high and high / low < 1.2


def test_what_is_no_table_of_sections_is_refused(tmp_path):
    """A column missing, a thickness of nothing: it says which."""
    with pytest.raises(InputError, match="columns x_mm,y_mm,z_mm,width_mm,depth_mm".replace(
            ",", ", ")):
        read_sections(table(tmp_path / "a.csv",
                            columns="x_mm,y_mm,z_mm,width_mm,depth_mm,mass_kg"), "m")
    wrong = table(tmp_path / "b.csv").read_text(encoding="utf-8").replace("24.0,", "0.0,", 1)
    (tmp_path / "b.csv").write_text(wrong, encoding="utf-8")
    with pytest.raises(InputError, match="width or height"):
        read_sections(tmp_path / "b.csv", "m")


# A cylinder model alone becomes a closed mesh: as our own branch, by another program's file.

EXAMPLE = Path(__file__).parents[2] / "blend_files" / "bending_branch"


def test_a_model_of_another_program_becomes_the_branch_again(tmp_path):
    """TreeQSM's .mat: the same axes and wood, closed, and it hangs like any branch."""
    Export(branch_folder=EXAMPLE, output=tmp_path / "tree.mat").run()
    folder = tmp_path / "a.branch"
    assert call(["mesh", str(tmp_path / "tree.mat"), "-o", str(folder), "--no-upright",
                 "--young", "2e8", "--json"]) == 0
    known, made = Branch.open(EXAMPLE), Branch.open(folder, verify=True)
    told = made.manifest.stages["mesh"].result
    assert told["watertight"] and told["branch_count"] == load_skeleton(known).branch_count
    volume = float(load_mesh(known).volumes.sum())
    assert told["mesh_volume_m3"] == pytest.approx(volume, rel=0.05)
    one, other = load_skeleton(known), load_skeleton(made)
    assert other.length == pytest.approx(one.length, rel=1e-6)
    np.testing.assert_allclose(other.nodes[-1] - other.nodes[0], one.nodes[-1] - one.nodes[0],
                               atol=1e-6)
    assert (load_branch(made).model.young == 2e8).all()


def test_the_unit_of_a_model_is_asked_about(tmp_path):
    """A skeleton in millimetres that was read as metres; and one of 1.7e18 m."""
    for height, text in ((71.9, "71.9 m long.*--unit mm"), (1.7e18, "1.7e.18 m long")):
        path = tmp_path / "long.swc"
        path.write_text(f"1 0 0 0 0 5 -1\n2 0 0 0 {0.5 * height} 5 1\n3 0 0 0 {height} 5 2\n")
        with pytest.raises(InputError, match=text):
            mesh_model(path, MeshSurfaceSettings())


def test_a_model_without_a_root_is_refused(tmp_path):
    """The first cylinder hangs on itself."""
    text = (EXAMPLE / "skeleton.csv").read_text()
    assert "\n0,-1," in text
    (tmp_path / "tree.csv").write_text(text.replace("\n0,-1,", "\n0,0,", 1))
    with pytest.raises(InputError, match="has 0 cylinders without a parent"):
        read_skeleton(tmp_path / "tree.csv")


def is_model(path):
    return body_format(path) in SKELETONS.readers()


def test_what_is_a_model_and_what_is_refused(tmp_path):
    for name, columns in (("rtwig.csv", "rtwig"), ("simple.csv", "simpleforest")):
        Export(branch_folder=EXAMPLE, output=tmp_path / name, columns=columns).run()
        assert is_model(tmp_path / name) and read_skeleton(tmp_path / name).length > 0.1
    (tmp_path / "sections.csv").write_text("# drawn\nx,y,z,width,height\n0,0,0,1,1\n0,0,9,1,1\n")
    assert not is_model(tmp_path / "sections.csv") and not is_model(tmp_path / "a.stl")
    assert is_model(tmp_path / "tree.swc")
    (tmp_path / "thin.swc").write_text("1 0 0 0 0 0 -1\n2 0 0 0 1 0.1 1\n")
    for path, settings, told in (
            ("thin.swc", MeshSurfaceSettings(), "radius 0"),
            ("rtwig.csv", MeshSurfaceSettings(root=(0.0, 0.0, 9.0)), "defines its own root")):
        with pytest.raises(InputError, match=told):
            Mesh.of(settings, surface=tmp_path / path, output=tmp_path / "b.branch").run()
    assert not (tmp_path / "b.branch").exists()
