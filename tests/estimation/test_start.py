"""A fit's start: a branch that stands and answers its force; failures are not numbers."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.subjects.forced_pulls import SETTINGS, TRUTH, with_force

from limber.core.errors import WorkError
from limber.core.progress import Progress
from limber.estimation.estimated_branch import forwards_of, lumped, subject_of
from limber.estimation.fitting import initial_modulus
from limber.estimation.fitting.objective import Evaluation, EvaluationLog, Objective
from limber.estimation.fitting.optimise import LONGEST_STEP, gauss_newton
from limber.estimation.forward.observed_path import force_for_travel
from limber.estimation.parameters import BULK, YOUNG_BOUNDS_PA, ParameterSpace, Values
from limber.estimation.settings import FitSpec, PullSpec
from limber.estimation.simulated_pull import TrueBranch, simulate_pull
from limber.geometry.reconstruction import mesh_skeleton
from limber.geometry.settings import ReconstructSettings
from limber.geometry.skeleton.skeleton import FRACTIONS, Skeleton
from limber.mechanics.grasp import Grasp
from limber.mechanics.statics.solve import solve_static
from limber.store import Branch
from limber.store.loading import load_subject


@pytest.mark.parametrize("young", [1e3, 6e5, 1e8, 1e11])
def test_a_measured_force_gives_the_start_whatever_the_modulus_was(objective, young):
    start = initial_modulus.scaled_start(objective, Values(np.full(4, young), 0.36, 900.0))
    expected = initial_modulus.scaled_start(objective, Values(np.full(4, 1e7), 0.36, 900.0))
    assert start.young == pytest.approx(expected.young, rel=1e-6)
    assert 0.3 * TRUTH.min() < start.young[0] < 3 * TRUTH.max()


def test_a_start_carries_the_weight(small_bench, pull):
    """A reading near zero says a modulus under which the branch would fold: it is stiffened."""
    objective = small_bench.objective([with_force(pull, lambda force: 1e-6 * force)], SETTINGS)
    forward = objective.forwards[0]
    forward._model = forward._model.with_parameters(gravity=(0.0, 0.0, -9.81)).as_scanned()
    start = initial_modulus.scaled_start(objective, Values(np.full(4, 1e3), 0.36, 900.0))
    assert forward.stands(start)
    assert not forward.stands(replace(start, young=0.25 * start.young))


def test_a_beam_bends_as_the_branch_does(objective, small_bench, pull):
    """Its sections' places from base to grasp, far bent, against the tetrahedra at the truth."""
    beam = initial_modulus.Beam(objective.forwards[0])
    moved, turns = beam.bent([Values(TRUTH, 0.36, 900.0)])
    seen = beam.seen[:, -1] - beam.seen[0, -1]
    off = moved[0, :, -1] - moved[0, 0, -1] - seen
    assert np.linalg.norm(seen, axis=1).max() > 0.15
    # The force has 2 % of noise.
    assert np.median(np.linalg.norm(off, axis=1)) < 0.05 * np.linalg.norm(seen, axis=1).max()
    assert np.swapaxes(turns, -1, -2) @ turns == pytest.approx(
        np.broadcast_to(np.eye(3), turns.shape), abs=1e-12)


def test_a_beam_under_a_small_force_is_bernoullis(objective):
    """F L^3 / 3 E I of its sections' radii, where it hardly bends."""
    beam = initial_modulus.Beam(objective.forwards[0])
    along = np.linspace(0.0, 0.5, initial_modulus.SECTIONS + 1)
    beam.axis = np.column_stack([0 * along, 0 * along, along])
    beam._second = np.full(initial_modulus.SECTIONS, 1e-9)
    beam.rest, beam._at = beam.axis[[-1]], np.array([initial_modulus.SECTIONS])
    beam.force, beam.torque = np.array([[1e-3, 0.0, 0.0]]), np.zeros((1, 3))
    beam.place = beam.axis[[-1]]
    beam._places, beam._turns = beam.axis[None], np.eye(3)
    moved, _ = beam.bent([Values(np.full(4, 1e7), 0.36, 900.0)])
    assert moved[0, 0, 0, 0] == pytest.approx(1e-3 * 0.5**3 / (3 * 1e7 * 1e-9), rel=2e-3)


@pytest.mark.parametrize("factor", [0.1, 1.0, 1e3])
def test_a_beam_scales_with_the_force(objective, factor):
    """A force so many times as large gives moduli so many times as large, within their bounds."""
    begun = initial_modulus.beam_start(initial_modulus.beams_of(objective.forwards),
                                       Values(np.full(4, 1e7), 0.36, 900.0))
    assert begun.explained > 0.9
    beams = initial_modulus.beams_of(objective.forwards)
    beams[0].force = factor * beams[0].force
    found = initial_modulus.beam_start(beams, Values(np.full(4, 1e7), 0.36, 900.0)).values
    assert found.young == pytest.approx(np.clip(factor * begun.values.young, 1e4, 1e11), rel=0.05)


def test_a_force_that_cannot_have_moved_the_branch_explains_nothing(objective):
    """Turned by 180 degrees no modulus answers it; of its frame the user is told."""
    beams = initial_modulus.beams_of(objective.forwards)
    beams[0].force = -beams[0].force
    assert initial_modulus.beam_start(beams, Values(np.full(4, 1e7), 0.36, 900.0)).explained < 0.3


@pytest.mark.parametrize("has_force", [False, True])
def test_decades_without_equilibrium_are_no_minimum(objective, monkeypatch, has_force):
    """Without force, or with one that no rod explains, the scale is searched; what fails there is
    too soft. A rod that explains nothing is likeliest where it does not move, at the bound."""
    def evaluate(self, free, **_options):
        known = None if free[0] < np.log(1e7) else Evaluation(
            free, np.array([1.0 + abs(free[0] - np.log(1e8))]), None, 0.0, ())
        return known

    monkeypatch.setattr(Objective, "evaluate", evaluate)
    if has_force:
        begun = initial_modulus.BeamStart(Values(np.full(4, 1e11), 0.36, 900.0), 0.0, {})
        monkeypatch.setattr(initial_modulus, "beam_start", lambda *_: begun)
    else:
        monkeypatch.setattr(objective.forwards[0], "skeleton", None)
    for young in (1e4, 1e8, 1e10):
        start = initial_modulus.scaled_start(objective, Values(np.full(4, young), 0.36, 900.0))
        assert start.young == pytest.approx(1e8, rel=0.3)


def test_a_branch_that_cannot_stand_is_refused_not_divided_by(small_bench):
    """No force is asked to move what falls by itself; before, its travel of zero was a divisor."""
    model = small_bench.model.with_parameters(young=1e4, gravity=(0.0, 0.0, -9.81)).as_scanned()
    tip = model.mesh.nodes[np.argmax(model.mesh.nodes[:, 2])]
    grasp = Grasp.at(model.mesh, tip, 0.012, "point")
    with pytest.raises(WorkError, match="equilibrium"):
        force_for_travel(model, grasp, np.array([1.0, 0.0, 0.0]), 0.02)
    sound = model.with_parameters(young=5e8)
    size = force_for_travel(sound, grasp, np.array([1.0, 0.0, 0.0]), 0.05)
    assert force_for_travel(sound.with_parameters(young=1e9), grasp, np.array([1.0, 0.0, 0.0]),
                            0.05) == pytest.approx(2 * size, rel=0.1)


@pytest.mark.slow
def test_a_travel_beyond_reach_is_refused(small_bench):
    """Before, the force of the farthest state was returned as if it moved that far."""
    model = small_bench.model
    tip = model.mesh.nodes[np.argmax(model.mesh.nodes[:, 2])]
    with pytest.raises(WorkError, match="No sideways force"):
        force_for_travel(model, Grasp.at(model.mesh, tip, 0.012, "point"),
                         np.array([1.0, 0.0, 0.0]), 1.0)


def test_a_failed_simulation_is_cheap_and_has_no_objective(small_bench, pull, tmp_path):
    """Its budget is counted in iterations; log and progress state no number for it."""
    lines = []
    plain = small_bench.objective([pull], SETTINGS)
    objective = Objective(plain.forwards, plain.space,
                          log=EvaluationLog(tmp_path / "log.jsonl", "p"),
                          progress=Progress(lambda *each: lines.append(each)))
    forward = objective.forwards[0]
    forward._model = forward._model.with_parameters(gravity=(0.0, 0.0, -9.81)).as_scanned()
    assert objective.evaluate(np.log(YOUNG_BOUNDS_PA[0]) * np.ones(4)) is None
    # The last solve may end its step.
    assert forward.iteration_count <= forward.iteration_limit + 20
    assert objective.log.best is None
    found = objective.evaluate(np.log(TRUTH))
    assert objective.log.best.objective == found.objective
    again = EvaluationLog(tmp_path / "log.jsonl", "p")
    assert again.resumed_count == 2 and again.best.objective == found.objective
    assert [message for _, message, _ in lines] == [
        "simulating", "no equilibrium", "simulating", "fitting"]
    json.dumps([numbers for *_, numbers in lines], allow_nan=False)


@pytest.mark.slow
def test_a_modulus_changes_at_most_threefold_a_step(small_bench, small_pull, monkeypatch):
    objective = small_bench.objective([small_pull], SETTINGS)
    evaluate, tried = Objective.evaluate, []

    def kept(self, free, **options):
        tried.append(free[:4].copy())
        return evaluate(self, free, **options)

    monkeypatch.setattr(Objective, "evaluate", kept)
    fit = gauss_newton(objective, np.log(40 * TRUTH))
    assert np.exp(fit.evaluation.free[:4]) == pytest.approx(TRUTH, rel=0.1)
    for number, free in enumerate(tried[1:], 1):
        assert min(np.abs(free - earlier).max()
                   for earlier in tried[:number]) <= LONGEST_STEP + 1e-9


# The free vector.

VALUES = Values(np.array([1e7, 2e7, 3e7, 4e7]), 0.4999, 800.0, (0.5, 0.002))


def test_pack_and_unpack_undo_each_other():
    """All kinds of parameters come back; what is not free keeps its value."""
    space = ParameterSpace.separate(VALUES, (BULK, "density", "alpha", "beta"))
    again = space.unpack(space.pack(VALUES))
    assert np.allclose(again.young, VALUES.young)
    told = again.poisson, again.density, *again.damping
    assert told == pytest.approx((0.4999, 800.0, 0.5, 0.002), rel=1e-6)
    fixed = ParameterSpace.separate(VALUES).unpack(np.log([1e6, 1e6, 1e6, 1e6]))
    assert fixed.poisson == 0.4999 and fixed.damping == (0.5, 0.002)


def test_ties_share_one_modulus():
    """Members of a group get one value, the geometric mean at the start; names say so."""
    space = ParameterSpace(VALUES, (0, 1, 1, 2))
    assert space.groups == (0, 1, 1, 2) and space.size == 3
    assert space.names == ["E1", "E2=E3", "E4"]
    young = space.unpack(space.pack(VALUES)).young
    assert young[1] == young[2] == pytest.approx(np.sqrt(2e7 * 3e7))


def test_bounds_are_named():
    """A modulus at its bound is named."""
    space = ParameterSpace.separate(VALUES)
    free = space.pack(VALUES)
    assert space.on_bound(free) == []
    free[2] = space.bounds()[1][2]
    assert space.on_bound(free) == ["E3"]


# What a fit starts from.


def _pulled(subject, young, reach):
    """A pull of a branch with these moduli as a rod, without noise."""
    return simulate_pull(TrueBranch(
        subject.mesh, subject.skeleton, subject.control_points, FRACTIONS, young,
        subject.model.gravity), "pull-1", PullSpec(
        model="rod", position_noise=0.0, force_noise=0.0, frames=20, reach=reach))[0]


@pytest.fixture(scope="module")
def twiggy():
    """A hanging branch with five twigs, a pull of it as a rod, and its whole and lumped subject."""
    rng = np.random.default_rng(5)
    along = np.linspace(0.0, 1.0, 41)
    stem = np.column_stack([0.2 * along**2, 0.05 * np.sin(3 * along), 0.5 * along])
    nodes, parents, radii = [stem], [np.arange(-1, 40)], [0.008 - 0.004 * along]
    for number, foot in enumerate((8, 14, 20, 26, 31)):
        out = rng.standard_normal(3) * [1, 1, 0.3]
        first = 41 + 10 * number
        nodes.append(stem[foot] + np.linspace(0.1, 1.0, 10)[:, None] * 0.15 * out
                     / np.linalg.norm(out))
        parents.append(np.r_[foot, np.arange(first, first + 9)])
        radii.append(np.full(10, 0.003))
    skeleton = Skeleton.from_edges(np.vstack(nodes), np.concatenate(parents), np.concatenate(radii))
    mesh = mesh_skeleton(skeleton, ReconstructSettings()).mesh
    mesh = mesh.with_data(cell_data={name: np.full(mesh.tet_count, value) for name, value in (
        ("young", 1e8), ("poisson", 0.35), ("density", 900.0))})
    settings = FitSpec(hold_out=False, key_frames=6)
    subject = subject_of(mesh, skeleton, (), (0.0, 0.0, -9.80665), settings)
    pull = _pulled(subject, TRUTH * 100, 0.2)
    return subject, lumped(subject, [pull], settings), pull, settings


def test_twigs_that_no_pull_reaches_are_rigid(twiggy):
    """The pull, its weight and its slopes are those of the whole branch."""
    whole, part, pull, settings = twiggy
    assert part.mesh.tet_count < 0.7 * whole.mesh.tet_count
    assert part.lumping.error < 5e-3
    values, found = replace(whole.start, young=TRUTH * 100), []
    for subject in (whole, part):
        forward = forwards_of([pull], subject, settings.model_copy(update={"drive": "force"}))[0]
        found.append(forward.simulate(values, (), True))
    moved = np.abs(found[0].positions - found[0].positions[0]).max()
    assert moved > 0.03
    assert np.abs(found[1].positions - found[0].positions).max() < 0.01 * moved
    assert np.abs(found[1].slopes.positions - found[0].slopes.positions).max() < 0.02 * np.abs(
        found[0].slopes.positions).max()
    heavy, light = (each.model.prestress.total.base.sum(axis=0) for each in (whole, part))
    assert light == pytest.approx(heavy, rel=1e-3, abs=1e-3)


@pytest.mark.slow
def test_a_branch_that_barely_stands_starts_from_its_moduli(twiggy):
    """Its weight bends it as much as the gripper does: where it was seen, not where a rod of any
    modulus would take it. Lumped twigs weigh on it too."""
    whole, part, _, settings = twiggy
    young = TRUTH * 100
    while part.carries_itself(replace(whole.start, young=0.7 * young)):
        young = 0.7 * young
    pull = _pulled(whole, young, 0.3)
    for subject in (whole, part):
        beams = initial_modulus.beams_of(forwards_of([pull], subject, settings))
        begun = initial_modulus.beam_start(beams, subject.start)
        assert begun.explained > 0.97 and begun.values.young == pytest.approx(young, rel=0.3)


def test_another_shape_of_a_lumped_branch_carries_its_twigs_too(twiggy):
    """Or the shape's error would be that of their weight, over a step of 1e-4."""
    _, part, pull, settings = twiggy
    forward = forwards_of([pull], part, settings)[0]
    beside = forward.with_prescribed_poses(forward.frames.poses).aside(part.mesh.nodes)
    known, again = (each.model.prestress.total.stiffness for each in (forward, beside))
    assert abs(again - known).max() < 1e-9 * abs(known).max()


def test_a_reached_twig_stays_meshed(twiggy):
    """One on which a point is observed."""
    whole, part, pull, settings = twiggy
    tip = whole.skeleton.nodes[50]
    seen = pull.entry.model_copy(update={"rest_points_m": (*map(
        tuple, whole.control_points), tuple(tip))})
    kept = lumped(whole, [replace(pull, entry=seen)], settings)
    near = np.linalg.norm(kept.mesh.nodes - tip, axis=1).min()
    assert near < 0.005 < np.linalg.norm(part.mesh.nodes - tip, axis=1).min()


def test_left_out_twigs_weigh_on_the_branch_that_is_fitted(branch_folder):
    """Twigs that the mesh leaves out hang on the model of a pull that gravity bends."""
    branch = Branch.open(branch_folder)
    bare = load_subject(branch, FitSpec()).model
    with branch.stage("mesh") as stage:
        stage.path("point_masses.json").write_text(json.dumps(
            [{"mass_kg": 0.02, "centre_m": [0.1, 0, 0.2], "attached_m": [0, 0, 0.2]}]))
    loaded = load_subject(branch, FitSpec()).model
    stiff = {"young": 1e12, "gravity": (0.0, 0.0, -9.80665)}
    base = [solve_static(model.with_parameters(**stiff)).require().base_force[2]
            for model in (bare, loaded)]
    assert base[1] - base[0] == pytest.approx(0.02 * 9.80665, rel=1e-6)


def test_bent_beams_are_those_of_the_plain_form():
    """Each section turns by the moment at its middle, which half of that at its begin leads to."""
    rng, sections = np.random.default_rng(3), 5
    axis = np.linspace(0.0, 0.3, sections + 1)[:, None] * [0.1, 0.2, 1.0]
    bending, twist = rng.uniform(0.05, 0.2, (2, 1, sections))
    force, grasp, torque = rng.normal(size=(1, 2, 3)), rng.normal(size=(1, 2, 3)), rng.normal(
        size=(2, 3))
    weight, held = 0.1 * rng.normal(size=(2, sections + 1, 3))
    hung = 0.01 * rng.normal(size=(1, 2, sections + 1, 3))
    places, turns = np.empty((1, 2, sections + 1, 3)), np.empty((1, 2, sections + 1, 3, 3))
    initial_modulus._bend_rods(axis, bending, twist, force, torque, grasp, weight, hung, held,
                               places, turns)
    for k in range(2):
        place, turned = axis[0], Rotation.identity()
        for s in range(sections):
            step = axis[s + 1] - axis[s]
            half, at, length = turned, place, np.linalg.norm(step)
            for middle in (axis[s], axis[s] + step / 2):
                moment = (np.cross(grasp[0, k] - at, force[0, k]) + torque[k] + hung[0, k, s + 1]
                          - np.cross(at, weight[s + 1])
                          - half.apply(held[s + 1] - np.cross(middle, weight[s + 1])))
                tangent = half.apply(step) / length
                along = (moment @ tangent) * tangent
                turn = length * ((moment - along) / bending[0, s] + along / twist[0, s])
                turn /= 2 * max(np.linalg.norm(turn), 1.0)
                half = Rotation.from_rotvec(turn) * turned
                at = place + half.apply(step) / 2
            place, turned = 2 * at - place, Rotation.from_rotvec(2 * turn) * turned
            np.testing.assert_allclose(places[0, k, s + 1], place, atol=1e-12)
            np.testing.assert_allclose(turns[0, k, s + 1], turned.as_matrix(), atol=1e-12)
