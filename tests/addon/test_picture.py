"""Set Up Picture: what is framed, in which colours; and a plan over the strength is not ticked."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from tests.addon.conftest import part
from tests.addon.test_panels import _draw_step

pytestmark = pytest.mark.usefixtures("worker_here", "whole_texts")

EXAMPLE = Path(__file__).parents[2] / "blend_files" / "bending_branch"


@pytest.fixture()
def example(bpy, registered, tmp_path):
    """The shipped example, opened beside Blender's startup camera and light."""
    bpy.ops.wm.read_factory_settings()
    shutil.copytree(EXAMPLE, tmp_path / "example")
    bpy.ops.limber.open_result(directory=str(tmp_path / "example"))
    return part("branch.branches").find_surface(bpy.context.scene)


@pytest.mark.slow
def test_the_picture_has_the_whole_motion_and_the_legends_colours(bpy, example):
    """At rest and bent, right of the legend; 1080 high; twice pressed is once made."""
    from bpy_extras.object_utils import world_to_camera_view
    from mathutils import Vector

    scene = bpy.context.scene
    for _ in range(2):
        assert bpy.ops.limber.set_up_picture() == {"FINISHED"}
    assert scene.view_settings.view_transform == "Standard"
    assert (scene.render.resolution_y, scene.camera.name.split(".")[0]) == (1080, "Camera")
    assert len([each for each in bpy.data.collections if "limber_picture" in each]) == 2
    assert bpy.data.objects["Light"].hide_render, "the startup light would outshine the colours"
    heights = []
    for frame in (scene.frame_start, scene.frame_end):
        scene.frame_set(frame)
        shape = example.evaluated_get(bpy.context.evaluated_depsgraph_get())
        seen = np.array([world_to_camera_view(scene, scene.camera, shape.matrix_world @ Vector(
            vertex.co)) for vertex in shape.data.vertices])
        assert (seen[:, :2] > 0.0).all() and (seen[:, :2] < 1.0).all()
        assert seen[:, 0].min() > 0.25, "the legend stands on the left"
        heights.append(np.ptp(seen[:, 1]))
    assert min(heights) > 0.4, "the branch fills the picture"
    bar = scene.objects["Scale bar"]
    assert bar.dimensions.z == pytest.approx(0.1), "a round length, for 0.5 m"
    assert scene.objects["Scale bar length"].data.body == "10 cm"
    ends = [world_to_camera_view(scene, scene.camera, bar.matrix_world @ Vector(corner))
            for corner in bar.bound_box]
    assert all(0 < end.x < 1 and 0 < end.y < 1 for end in ends)
    assert np.ptp([end.y for end in ends]) > 0.1, "more than a hundred pixels high"
    words = [thing.data.body for thing in scene.objects if thing.type == "FONT"]
    assert any("Young" in text or "modulus" in text for text in words), words


@pytest.mark.slow
def test_wood_in_a_picture_without_legend(bpy, example, tmp_path):
    """It stays when a result is shown again; the branch is in the middle then, and brown."""
    materials, scene = part("bridge.materials"), bpy.context.scene
    assert bpy.ops.limber.color_by(scalar="wood") == {"FINISHED"}
    bpy.ops.limber.open_result()
    assert example.material_slots[0].material[materials.KEY] == materials.WOOD
    assert example.data.color_attributes.active_color_name == "wood_color"
    assert not part("show.legend").shown_scales(example)
    scene.limber.show_legend = False
    bpy.ops.limber.set_up_picture()
    assert scene.camera.data.shift_x == 0.0
    assert not [each for each in bpy.data.collections if each.name.startswith("Legend")]
    for group in ("marks", "control_points", "goal", "paths"):
        bpy.ops.limber.show(group=group, hide=True)
    scene.render.resolution_percentage, scene.cycles.samples = 15, 4
    scene.render.filepath = str(tmp_path / "wood.png")
    bpy.ops.render.render(write_still=True)
    pixels = np.empty((162, 216, 4), np.float32)
    bpy.data.images.load(scene.render.filepath).pixels.foreach_get(pixels.ravel())
    red, blue = pixels[..., 0], pixels[..., 2]
    is_wood = red > 1.3 * blue
    assert 0.01 < is_wood.mean() < 0.2
    assert np.ptp(red[is_wood]) > 0.2, "furrows, not one colour"
    assert bpy.ops.limber.color_by(scalar="young") == {"FINISHED"}
    assert example.material_slots[0].material[materials.KEY] != materials.WOOD


@pytest.mark.slow
def test_a_plan_over_the_strength_is_not_ticked(bpy, example):
    """1.8 times the assumed strength: said so, in the panel and its header; with stronger wood it
    is done."""
    steps, scene = part("panels.steps"), bpy.context.scene
    step = bpy.types.LIMBER_PT_plan.step
    assert steps.stress_share(scene) == pytest.approx(1.8, abs=0.05)
    assert steps.step_state(scene, step) is part("jobs.steps").StepState.OVER_STRENGTH
    drawn = _draw_step(bpy, "plan")
    assert any(text.startswith("May break: stress 1.8") for text in drawn.names("label"))
    assert "The stress exceeds the strength of the wood" in drawn.names("label")
    scene.limber.scene.use_strength, scene.limber.scene.strength = True, 500e6
    bpy.ops.limber.open_result()
    assert steps.step_state(scene, step) is part("jobs.steps").StepState.DONE
    assert "The stress exceeds the strength of the wood" not in _draw_step(
        bpy, "plan").names("label")


def test_the_scale_bar_has_a_round_length(addon):
    """A quarter of the branch at most, in the unit that suits."""
    scale_bar = part("show.scale_bar")
    assert [scale_bar.length_for(size) for size in (0.01, 0.3, 4.1, 30.0)] == pytest.approx(
        [0.002, 0.05, 1.0, 5.0])
    assert [scale_bar.words_for(length) for length in (0.002, 0.05, 0.5, 1.0, 20.0)] == [
        "2 mm", "5 cm", "50 cm", "1 m", "20 m"]
