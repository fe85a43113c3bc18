"""What was measured in a pull over the motion that replays it: places, residual, force."""

import json
import struct

import numpy as np
import pytest

from limber.geometry.tets.tree_sweep import straight_beam
from limber.results.scene.contents import scene_data
from limber.store import Branch

PULL = {
    "pulls/a/pull.toml": "observation = 'markers'\nrest_points_m = [[0.0, 0.0, 0.5], "
                         "[0.0, 0.0, 0.2]]\n[grasp]\npoint_m = [0.0, 0.0, 0.3]\n"
                         "radius_m = 0.01\n",
    # The robot's clock begins at 3 s.
    "pulls/a/robot.csv": "t_s,x_m,y_m,z_m,rx_rad,ry_rad,rz_rad,fx_n,fy_n,fz_n,tx_nm,ty_nm,tz_nm\n"
                         "3,0,0,0.3,0,0,0,0,0,0,0,0,0\n4,0.1,0,0.3,0,0,0,0,3,4,0,0,0\n",
    "pulls/a/markers.csv": "t_s,m0_x_m,m0_y_m,m0_z_m,m1_x_m,m1_y_m,m1_z_m\n"
                           "3,0,0,0.5,0,0,0.2\n3.5,,,,0.02,0,0.2\n4,0.2,0,0.5,0.04,0,0.2\n"}


@pytest.fixture()
def branch(tmp_path):
    """A beam with a pull, and a motion of its name that goes 5 frames along x as one body."""
    mesh = straight_beam(0.5, 0.01, slice_count=6, grasp_fraction=0.67)
    surface = mesh.nodes[np.unique(mesh.surface_faces())]
    frames = np.repeat(surface[None], 5, axis=0)
    frames[:, :, 0] += np.linspace(0, 0.2, 5)[:, None]
    head = struct.pack("<12siiffi", b"POINTCACHE2\0", 1, len(surface), 0.0, 1.0, 5)
    branch = Branch.create(tmp_path / "a.branch")
    with branch.stage("reconstruct") as stage:
        mesh.write(stage.path("mesh.vtu"))
    with branch.stage("pull:a") as stage:
        for name, content in PULL.items():
            stage.path(name).write_text(content)
    with branch.stage("replay:a") as stage:
        stage.path("frames/a.pc2").write_bytes(head + frames.astype("<f4").tobytes())
        stage.path("frames/a.json").write_text(json.dumps(
            {"rate": 4.0, "times_s": [0, 0.25, 0.5, 0.75, 1.0]}))
    return Branch.open(branch.folder)


def test_what_was_measured_over_time(branch):
    """Observed points of a pull; one not seen stands where it was last and is flagged."""
    data = scene_data(branch)
    assert data.info["observation"] == {"pull": "a", "is_shown": True}
    np.testing.assert_allclose(data.arrays["observation"][:, 0, 0], [0, 0, 0.2])
    np.testing.assert_array_equal(data.arrays["observation_visible"][:, 0], [True, False, True])
    np.testing.assert_allclose(data.arrays["observation_grasp"][:, 0], [0, 0.1])


def test_each_frame_has_what_was_measured_then(branch):
    """On the frames' clock, not the robot's; between two looks on the line; unseen in between."""
    arrays = scene_data(branch).arrays
    np.testing.assert_allclose(arrays["observation_motion"][:, 0, 0], [0, 0.05, 0.1, 0.15, 0.2])
    np.testing.assert_allclose(arrays["observation_motion"][:, 1, 0],
                               [0, 0.01, 0.02, 0.03, 0.04])
    assert not arrays["observation_seen"][2, 0] and arrays["observation_seen"][[0, 4], 0].all()
    assert arrays["observation_seen"][:, 1].all()


def test_the_residual_follows_the_frames(branch):
    """The beam goes 0.2 m, its lower mark was seen to go 0.04 m: 0.16 m off about it at the end,
    nothing at the start; near the upper mark, which was met, far less."""
    data = scene_data(branch)
    residual, vertices = data.arrays["frame_scalar:residual"], data.arrays["vertices"]
    assert residual.shape == (5, len(vertices))
    assert residual[0].max() < 1e-6
    low = np.linalg.norm(vertices - [0, 0, 0.2], axis=1).argmin()
    top = np.linalg.norm(vertices - [0, 0, 0.5], axis=1).argmin()
    assert residual[-1, low] == pytest.approx(0.16, rel=0.03)
    assert residual[-1, top] < 0.01
    # The upper mark is not seen in the middle: the lower one alone counts there.
    np.testing.assert_allclose(residual[2], 0.08, rtol=1e-5)
    assert "pull a" in data.info["frame_scalars"]["residual"]["title"]
    np.testing.assert_allclose(data.arrays["scalar:residual"], residual.max(axis=0), rtol=1e-6)


def test_the_force_over_time_has_a_cursor_at_each_frame(branch):
    """Measured 0 and 5 N at 3 and 4 s; the cursor goes from the one to the other."""
    graph = scene_data(branch).info["graphs"]["force"]
    assert [line["label"] for line in graph["lines"]] == ["measured"]
    places = graph["lines"][0]["points"]
    assert places[1][1] / 5.0 == pytest.approx(1 / 5.3, rel=0.01)
    np.testing.assert_allclose([graph["cursor"][0], graph["cursor"][-1]],
                               [places[0][0], places[1][0]], atol=1e-4)


def test_another_motion_is_not_compared(branch):
    """Frames of something else: the measurement is there, but in no frame, and has no residual."""
    with branch.stage("simulate") as stage:
        for ending in ("pc2", "json"):
            stage.path(f"frames/s.{ending}").write_bytes(
                branch.path(f"frames/a.{ending}").read_bytes())
    data = scene_data(branch, motion="s")
    assert data.info["observation"] == {"pull": "a", "is_shown": False}
    assert "observation" in data.arrays and "observation_motion" not in data.arrays
    assert "residual" not in data.info["scalars"]
    assert data.info["graphs"]["force"]["cursor"] == []
