"""The goal's ball in the view and the goal of the plan are one; a plan samples what it lacks."""

import json
import math
import shutil

import numpy as np
import pytest
from tests.addon.conftest import ROOT, Ended, part

from limber.planning.field.energy_field import EnergyField

pytestmark = pytest.mark.usefixtures("worker_here")


@pytest.fixture()
def ball(bpy, registered, beam):
    """An opened branch with a plan, and the ball of its goal."""
    bpy.ops.limber.open_result(directory=str(beam.folder))
    surface = part("branch.branches").find_surface(bpy.context.scene)
    return part("plan.goal_ball").of(part("branch.branches").branch_of(surface))


@pytest.mark.slow
def test_moving_the_ball_moves_the_plans_goal(bpy, ball, monkeypatch):
    """As G does; in the branch's frame where it was put aside. Then the plan is out of date."""
    plan = bpy.context.scene.limber.plan
    assert not plan.use_goal, "opening moves nothing"
    plan.use_goal_seed = True
    for thing in ball.users_collection[0].objects:
        thing.delta_location = (2.0, 0.0, 0.0)
    bpy.context.view_layer.update()
    assert not plan.use_goal
    ball.location = (0.1, 0.2, 0.3)
    bpy.context.view_layer.update()
    assert plan.use_goal and not plan.use_goal_seed
    assert list(plan.goal) == pytest.approx([0.1, 0.2, 0.3])
    stage = part("jobs.stages").stages()["plan"]
    assert part("properties").differs(plan, stage, {"goal": [0.1, 0.2, 0.31]})
    assert not part("properties").differs(plan, stage, {"goal": [0.1, 0.2, 0.3]})


@pytest.mark.slow
def test_dragging_the_handle_moves_the_plans_goal(bpy, ball):
    """By a displacement in the world, also where the branch was put aside and turned."""
    scene, before = bpy.context.scene, list(ball.location)
    surface = part("branch.branches").find_surface(scene)
    surface.delta_rotation_euler = (0.0, 0.0, math.pi / 2)
    bpy.context.view_layer.update()
    assert bpy.ops.limber.drag_goal(move=(0.0, 0.1, 0.0)) == {"FINISHED"}
    wanted = [before[0] + 0.1, before[1], before[2]]
    assert list(ball.location) == pytest.approx(wanted, abs=1e-6)
    assert scene.limber.plan.use_goal
    assert list(scene.limber.plan.goal) == pytest.approx(wanted, abs=1e-6)
    bpy.data.objects.remove(ball)
    with pytest.raises(RuntimeError, match="no goal"):
        bpy.ops.limber.drag_goal(move=(0.0, 0.1, 0.0))


@pytest.mark.slow
def test_the_ball_is_an_active_object_that_gives_the_goal(bpy, ball):
    """From Active Object takes its place; the tolerance is not the size of what is seen."""
    plan = bpy.context.scene.limber.plan
    tolerance = plan.goal_tolerance
    part("branch.branches").activate(bpy.context.scene, ball)
    assert bpy.ops.limber.from_object(region="goal") == {"FINISHED"}
    assert list(plan.goal) == pytest.approx(list(ball.location))
    assert plan.use_goal and plan.goal_tolerance == tolerance


@pytest.mark.slow
def test_a_goal_from_elsewhere_is_shown_by_the_ball(bpy, ball):
    """From the cursor and from another object: one goal, and it is where the ball is. A box is a
    goal instead of it."""
    plan, scene = bpy.context.scene.limber.plan, bpy.context.scene
    scene.cursor.location = (0.1, 0.0, 0.4)
    bpy.ops.limber.from_cursor(stage="plan", field="tip_goal")
    assert list(ball.location) == pytest.approx([0.1, 0.0, 0.4])
    assert plan.use_tip_goal and not plan.use_goal
    bpy.ops.mesh.primitive_cube_add(size=0.1, location=(0.0, 0.2, 0.3))
    assert bpy.ops.limber.from_object(region="goal") == {"FINISHED"}
    assert list(ball.location) == pytest.approx([0.0, 0.2, 0.3])
    assert plan.use_goal and not plan.use_tip_goal
    assert plan.goal_tolerance == pytest.approx(0.05)
    ball.location = (0.3, 0.2, 0.3)
    bpy.context.view_layer.update()
    assert list(plan.goal) == pytest.approx([0.3, 0.2, 0.3]), "moving it still moves the goal"
    bpy.ops.limber.from_object(region="target_box")
    assert plan.use_target_box and not plan.use_goal


@pytest.mark.slow
def test_a_branch_without_a_plan_gets_a_ball(bpy, registered, bare_beam):
    """At the plan's goal; selected, so that G moves it. Pressed again, it is the same one."""
    bpy.ops.limber.open_result(directory=str(bare_beam.folder))
    scene = bpy.context.scene
    scene.limber.plan.goal, scene.limber.plan.use_goal = (0.0, 0.1, 0.5), True
    for _ in range(2):
        assert bpy.ops.limber.place_goal() == {"FINISHED"}
    balls = [thing for thing in bpy.data.objects if thing.name.startswith("Goal")]
    assert balls == [bpy.context.view_layer.objects.active] and balls[0].select_get()
    assert list(balls[0].location) == pytest.approx([0.0, 0.1, 0.5])


@pytest.mark.slow
def test_a_plan_samples_the_energy_that_it_lacks(bpy, registered, bare_beam, monkeypatch):
    """Once, before it; nothing is sampled where it is there. Where it fails, no plan is begun."""
    bpy.ops.limber.open_result(directory=str(bare_beam.folder))
    jobs = part("jobs.jobs")
    ran, code, launch = [], [0], jobs.Job.launch

    def launch_here(job):
        stage = job.command[job.command.index("limber") + 1]
        if stage not in ("energy", "plan"):
            return launch(job)
        ran.append(stage)
        if stage == "energy":
            path = bare_beam.folder / "branch.json"
            content = json.loads(path.read_text())
            content["stages"]["energy"] = {"settings": {}, "reads": {}, "result": {},
                                           "finished": "2030-01-01"}
            path.write_text(json.dumps(content))
        job._process = Ended(code[-1], *([""] * bool(code[-1])))
        job.state = jobs.JobState.RUNNING
        return None
    monkeypatch.setattr(jobs.Job, "launch", launch_here)
    for _ in range(2):
        assert bpy.ops.limber.plan(name="first") == {"FINISHED"}
    assert ran == ["energy", "plan", "plan"]
    path = bare_beam.folder / "branch.json"
    content = json.loads(path.read_text())
    del content["stages"]["energy"]
    path.write_text(json.dumps(content))
    code.append(3)
    with pytest.raises(RuntimeError, match="exit code 3"):
        bpy.ops.limber.plan(name="first")
    assert ran == ["energy", "plan", "plan", "energy"]


@pytest.mark.slow
def test_the_grasp_is_dragged_to_a_goal(bpy, registered, bare_beam):
    """Without a plan: a ball is made there, and is the plan's goal. Put back, there is neither."""
    bpy.ops.limber.open_result(directory=str(bare_beam.folder))
    scene, goal_ball = bpy.context.scene, part("plan.goal_ball")
    surface = part("branch.branches").find_surface(scene)
    branch = part("branch.branches").branch_of(surface)
    bpy.context.view_layer.update()
    before = goal_ball.Before.of(scene, branch)
    assert bpy.ops.limber.drag_goal(mark="Grasp 1", move=(0.05, 0.0, -0.01)) == {"FINISHED"}
    grasp = branch.objects["Grasp 1"].delta_location
    wanted = [grasp.x + 0.05, grasp.y, grasp.z - 0.01]
    assert list(goal_ball.of(branch).location) == pytest.approx(wanted, abs=1e-6)
    assert scene.limber.plan.use_goal
    assert list(scene.limber.plan.goal) == pytest.approx(wanted, abs=1e-6)
    before.put_back(scene, branch)
    assert goal_ball.of(branch) is None and not scene.limber.plan.use_goal
    with pytest.raises(RuntimeError, match="has no Grasp 7"):
        bpy.ops.limber.drag_goal(mark="Grasp 7", move=(0.05, 0.0, 0.0))


@pytest.mark.slow
def test_a_target_is_dragged_to_a_goal(bpy, ball, beam):
    """The plan's goal becomes that of the named target, and no longer that of the grasp."""
    assert bpy.ops.limber.target(name="bud", at=(0.0, 0.0, 0.3)) == {"FINISHED"}
    bpy.ops.limber.open_result(directory=str(beam.folder))
    bpy.context.view_layer.update()
    scene, plan = bpy.context.scene, bpy.context.scene.limber.plan
    branch = part("branch.branches").branch_of(part("branch.branches").find_surface(scene))
    mark = branch.objects["Target bud"]
    plan.use_goal = True
    before = part("plan.goal_ball").Before.of(scene, branch)
    place = part("plan.goal_ball").of(branch).location.copy()
    assert bpy.ops.limber.drag_goal(mark=mark.name, move=(0.0, 0.1, 0.0)) == {"FINISHED"}
    assert (plan.use_tip_goal, plan.use_goal, plan.target) == (True, False, "bud")
    wanted = [mark.delta_location.x, mark.delta_location.y + 0.1, mark.delta_location.z]
    assert list(plan.tip_goal) == pytest.approx(wanted, abs=1e-6)
    before.put_back(scene, branch)
    bpy.context.view_layer.update()
    assert (plan.use_tip_goal, plan.use_goal, plan.target) == (False, True, "")
    assert list(part("plan.goal_ball").of(branch).location) == list(place)


@pytest.mark.slow
def test_the_slice_shows_the_energy_field(bpy, registered, tmp_path):
    """In the plane through a place: the colours of the core's field, transparent where it is not
    trusted; in the world, also where the branch was put aside."""
    from mathutils import Vector

    folder = tmp_path / "twig.branch"
    shutil.copytree(ROOT / "blend_files" / "bending_branch", folder)
    bpy.ops.limber.open_result(directory=str(folder))
    scene = bpy.context.scene
    surface = part("branch.branches").find_surface(scene)
    branch = part("branch.branches").branch_of(surface)
    for thing in branch.objects:
        thing.delta_location = (2.0, 0.0, 0.0)
    bpy.context.view_layer.update()
    thing, field = part("plan.energy_field").of(branch), EnergyField.read(folder / "energy.npz")
    assert thing.hide_render and not thing.visible_get()
    # The field's own numbers, at the points of the grid.
    meshes = part("bridge.meshes")
    points = meshes.positions(thing.data).astype(float)
    colours = part("plan.energy_field").colours_at(thing, points)
    assert len(points) > 100 and (colours[:, 3] > 0.99).mean() > 0.99
    np.testing.assert_allclose(meshes.values_of(thing.data, "energy_j"), field.energy(points),
                               rtol=2e-2, atol=1e-5)
    np.testing.assert_allclose(colours, meshes.values_of(thing.data, "color"), atol=0.02)
    aside = points + [0.0, 0.0, 0.5]
    assert (part("plan.energy_field").colours_at(thing, aside)[:, 3] == 0).all()
    place = Vector(field.rest) + Vector((2.0, 0.0, 0.0))
    across, up = Vector((1.0, 0.0, 0.0)), Vector((0.0, 0.0, 1.0))
    at, seen, triangles = part("plan.energy_slice").net(thing, surface, place, across, up)
    np.testing.assert_allclose(at[:, 1], place.y)
    assert len(triangles) > 50 and (seen[triangles, 3] > 0).any(axis=1).all()
    nearest = np.argmin(np.linalg.norm(at - np.array(place), axis=1))
    rest = part("plan.energy_field").colours_at(thing, np.array([field.rest]))[0, :3].sum()
    assert seen[nearest, 3] > 0
    assert rest < np.quantile(colours[:, :3].sum(axis=1), 0.25), "the least energy is dark"
    assert not scene.limber.show_energy_slice and not part("plan.energy_field").is_sliced(scene)
    scene.limber.show_energy_slice = True
    scales = part("show.legend").shown_scales(surface)
    assert any("with the grasp there" in scale["title"] for scale in scales)
