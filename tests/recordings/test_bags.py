"""Bags: written, read back the same; what a stranger's bag lacks is said."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from limber.cell.cell_file import Cell, read_cell, write_cell
from limber.core.errors import InputError
from limber.core.numerics.rigid import pose_vectors
from limber.core.progress import Progress
from limber.geometry.cloud.camera import Camera, read_camera, write_camera
from limber.geometry.io.depth_images import depth_metres
from limber.perception.observe import write_depth
from limber.recordings import bag_pull, bag_reader
from limber.recordings.bag_pull import _Messages, pull_of_bag, write_mcap
from limber.recordings.bag_reader import Bag, Topic, bag_arrays, read_bag, stamped
from limber.recordings.import_request import ImportRequest
from limber.recordings.recording import CalibrationEntry, read_pull, write_pull
from limber.recordings.settings import ImportSpec
from limber.stages.moduli import estimate as stage
from limber.stages.pulls.export_pull import ExportPull
from limber.stages.pulls.import_pull import ImportPull

pytest.importorskip("rosbags")


@pytest.fixture
def apart():
    """Bags are read by another process, as in earnest."""


@pytest.fixture(autouse=True)
def read_here(request, monkeypatch):
    """Elsewhere by this one: to start another takes a second."""
    if "apart" not in request.fixturenames:
        monkeypatch.setattr(bag_reader, "read_apart", lambda reader, path: reader(path))


@pytest.fixture
def mcap(tmp_path, plain_pull):
    """The hand-made pull as an MCAP file."""
    write_pull(tmp_path / "spring", plain_pull)
    write_mcap(tmp_path / "run.mcap", tmp_path / "spring", plain_pull)
    return tmp_path / "run.mcap"


class Written:
    """Messages into an MCAP file, one by one."""

    def __init__(self, path, **options):
        from mcap.writer import Writer

        self._stream = open(path, "wb")
        self._writer, self._channels = Writer(self._stream, **options), {}
        self._writer.start(profile="ros2", library="test")
        self.made = _Messages()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._writer.finish()
        self._stream.close()

    def add(self, topic, message, logged):
        store, kind = self.made.store, message.__msgtype__
        if topic not in self._channels:
            text, _ = store.generate_msgdef(kind, ros_version=2)
            schema = self._writer.register_schema(kind, "ros2msg", text.encode())
            self._channels[topic] = self._writer.register_channel(topic, "cdr", schema)
        stamp = round(1e9 * logged)
        self._writer.add_message(self._channels[topic], stamp,
                                 bytes(store.serialize_cdr(message, kind)), stamp)

    def wrench(self, topic, seconds, force, frame="branch", stamp=None):
        message = self.made.wrench(np.r_[force, np.zeros(3)], seconds if stamp is None else stamp)
        message.header.frame_id = frame
        self.add(topic, message, seconds)

    def pose(self, topic, seconds, position, frame="branch"):
        message = self.made.pose(np.r_[position, np.zeros(3)], seconds)
        message.header.frame_id = frame
        self.add(topic, message, seconds)

    def transform(self, seconds, child, pose, parent="branch"):
        moved = self.made.transform(child, np.asarray(pose, float), seconds)
        moved.transforms[0].header.frame_id = parent
        self.add("/tf", moved, seconds)

    def joints(self, seconds, names, angles):
        self.add("/joint_states", self.made.make(
            "sensor_msgs/msg/JointState", header=self.made.header(seconds, ""), name=names,
            position=np.array(angles, float), velocity=np.zeros(0), effort=np.zeros(0)), seconds)


def pulled(bag: Written, *, wrench="/wrench", pose="/pose", shift=0.0):
    """A spring of 50 N/m pulled out by 0.1 m in 2 s."""
    for time in np.linspace(1.0, 3.0, 101):
        way = 0.05 * (time - 1.0)
        if wrench:
            bag.wrench(wrench, time, [50.0 * way, 0.0, 0.0], stamp=time + shift)
        if pose:
            bag.pose(pose, time, [way, 0.0, 0.5])


@pytest.mark.slow
@pytest.mark.usefixtures("apart")
def test_a_pull_comes_back_as_it_was(mcap, bare_folder, plain_pull):
    """Poses, wrenches and markers through MCAP; frames need no option."""
    result = ImportPull(branch_folder=bare_folder, source=mcap, name="again").run()
    assert result["kind"] == "bag" and result["point_count"] == 2
    pull = read_pull(bare_folder / "pulls" / "again")
    assert np.allclose(pull.times, plain_pull.times, atol=1e-6)
    assert np.allclose(pull.poses, plain_pull.poses, atol=1e-8)
    assert np.allclose(pull.wrenches, plain_pull.wrenches, atol=1e-7)
    assert np.allclose(pull.observations.positions, plain_pull.observations.positions, atol=1e-8)
    assert np.allclose(pull.observations.times, plain_pull.observations.times, atol=1e-6)
    ExportPull(branch_folder=bare_folder, name="again", mcap=bare_folder.parent / "out.mcap").run()
    assert read_bag(bare_folder.parent / "out.mcap").of("wrench")[0].values.shape == (201, 6)


@pytest.mark.slow
def test_a_rosbag2_folder_is_read_as_well(mcap, tmp_path, bare_folder, plain_pull):
    """The same messages as ROS 2's own recorder leaves them: a folder with SQLite."""
    from rosbags.highlevel import AnyReader
    from rosbags.rosbag2 import Writer

    with AnyReader([mcap]) as reader, Writer(tmp_path / "bag2", version=9) as writer:
        known = {c.topic: writer.add_connection(c.topic, c.msgtype, typestore=reader.typestore)
                 for c in reader.connections}
        for connection, logged, raw in reader.messages():
            writer.write(known[connection.topic], logged, raw)
    ImportPull(branch_folder=bare_folder, source=tmp_path / "bag2", name="again").run()
    pull = read_pull(bare_folder / "pulls" / "again")
    assert np.allclose(pull.wrenches, plain_pull.wrenches, atol=1e-7)


@pytest.mark.slow
def test_depth_images_come_with_their_camera(tmp_path, bare_folder, plain_pull):
    """In another scale, the same depths; the camera where TF has it."""
    folder = tmp_path / "depth_pull"
    pull = replace(plain_pull, observations=None,
                   entry=plain_pull.entry.model_copy(update={"observation": "depth"}))
    write_pull(folder, pull)
    camera = Camera(width=32, height=24, fx=30.0, fy=31.0, cx=15.0, cy=12.0, depth_scale=4000.0,
                    pose=(0.1, -1.0, 0.3, -1.2, 0.1, 0.2))
    write_camera(folder / "camera.toml", camera)
    (folder / "depth").mkdir()
    depths = np.random.default_rng(1).uniform(0.5, 1.5, (3, 24, 32))
    for time, depth in zip((0.5, 1.5, 2.5), depths, strict=True):
        write_depth(folder / "depth" / f"{time:.6f}.png", depth, camera)
    write_mcap(tmp_path / "run.mcap", folder, pull)
    ImportPull(branch_folder=bare_folder, source=tmp_path / "run.mcap", name="seen").run()
    target = bare_folder / "pulls" / "seen"
    found = read_camera(target / "camera.toml")
    assert found.pose == pytest.approx(camera.pose) and found.fy == 31.0
    files = sorted((target / "depth").glob("*.png"))
    assert [float(file.stem) for file in files] == pytest.approx([0.5, 1.5, 2.5], abs=1e-6)
    first = files[0]
    assert np.allclose(depth_metres(first, found), depths[0], atol=1e-3)


def test_a_sensors_own_frame_is_turned_by_tf(tmp_path, bare_folder):
    """Gripper in TF, wrench in a sensor's frame turned against it and 50 mm behind it."""
    turned = Rotation.from_euler("z", 90, degrees=True)
    with Written(tmp_path / "tf.mcap") as bag:
        bag.transform(0.0, "sensor", np.r_[-0.05, 0, 0, turned.as_rotvec()], parent="tool0")
        for time in np.linspace(1.0, 3.0, 51):
            way = 0.05 * (time - 1.0)
            bag.transform(time, "tool0", [way, 0, 0.5, 0, 0, 0])
            # 50 way N along the branch's y is along the sensor's x.
            bag.wrench("/wrench", time, [50.0 * way, 0.0, 0.0], frame="sensor")
    ImportPull(branch_folder=bare_folder, source=tmp_path / "tf.mcap", name="tf").run()
    pull = read_pull(bare_folder / "pulls" / "tf")
    way = pull.poses[:, 0]
    assert np.allclose(pull.poses[:, 2], 0.5) and way[-1] == pytest.approx(0.1)
    assert np.allclose(pull.wrenches[:, :3], np.outer(50 * way, [0, 1, 0]), atol=1e-9)
    # 50 mm behind the gripper: a torque about it.
    assert np.allclose(pull.wrenches[:, 5], -0.05 * 50 * way, atol=1e-9)
    assert pull.entry.observation == "none"


@pytest.mark.slow
def test_joint_angles_need_the_cell(tmp_path, bare_folder):
    """In any order, with a robot's own names; the base's pose in the branch's frame is the
    cell's."""
    names = ["elbow_joint", "shoulder_lift_joint", "shoulder_pan_joint", "wrist_1_joint",
             "wrist_2_joint", "wrist_3_joint"]
    with Written(tmp_path / "joints.mcap") as bag:
        for time in np.linspace(1.0, 3.0, 21):
            bag.joints(time, names, [1.4, -1.5, 0.1 * time, -1.2, -1.5, 0.2])
            bag.wrench("/wrench", time, [time - 1, 0, 0])
    with pytest.raises(InputError, match="--cell"):
        ImportPull(branch_folder=bare_folder, source=tmp_path / "joints.mcap", name="j").run()
    cell = Cell(robot={"model": "ur5e"}, base={"pose": (0.4, 0.2, 0.0, 0, 0, 0)})
    write_cell(tmp_path / "cell.toml", cell)
    ImportPull(branch_folder=bare_folder, source=tmp_path / "joints.mcap", name="j",
               cell=str(tmp_path / "cell.toml")).run()
    pull = read_pull(bare_folder / "pulls" / "j")
    expected = pose_vectors(cell.arm.forward(np.array([0.1, -1.5, 1.4, -1.2, -1.5, 0.2])))
    assert np.allclose(pull.poses[0, :3], expected[:3] + [0.4, 0.2, 0.0])


@pytest.mark.slow
def test_joints_are_called_as_the_cells_arm_calls_them(tmp_path, bare_folder, recorded_data):
    """The arm of a URDF file whose first joint has a name of its own."""
    text = (recorded_data / "ur5_urdf" / "ur5.urdf").read_text(encoding="utf-8")
    (tmp_path / "own.urdf").write_text(text.replace("shoulder_pan_joint", "waist"),
                                       encoding="utf-8")
    path = tmp_path / "cell.toml"
    path.write_text('[robot]\nmodel = "own.urdf"\n[base]\npose = [0, 0, 0, 0, 0, 0]\n',
                    encoding="utf-8")
    names = ["elbow_joint", "shoulder_lift_joint", "waist", "wrist_1_joint", "wrist_2_joint",
             "wrist_3_joint"]
    for called in (names, [*names[:2], "shoulder_pan_joint", *names[3:]]):
        with Written(tmp_path / "joints.mcap") as bag:
            for time in np.linspace(1.0, 3.0, 21):
                bag.joints(time, called, [1.4, -1.5, 0.1 * time, -1.2, -1.5, 0.2])
                bag.wrench("/wrench", time, [time - 1, 0, 0])
        settings = ImportSpec(cell=str(path))
        if called is names:
            ImportPull.of(settings, branch_folder=bare_folder, source=tmp_path / "joints.mcap",
                          name="j").run()
            pull = read_pull(bare_folder / "pulls" / "j")
            place = read_cell(path).arm.forward(np.array([0.1, -1.5, 1.4, -1.2, -1.5, 0.2]))
            assert np.allclose(pull.poses[0, :3], pose_vectors(place)[:3])
        else:
            with pytest.raises(InputError, match=r"joints are named.*waist, shoulder_lift_joint"):
                ImportPull.of(settings, branch_folder=bare_folder, source=tmp_path / "joints.mcap",
                              name="k").run()


@pytest.mark.parametrize("made, told", [
    (lambda bag: pulled(bag, wrench=None), "no wrench.*Its topics: /pose"),
    (lambda bag: pulled(bag, pose=None), "no pose"),
    (lambda bag: (pulled(bag), pulled(bag, wrench="/other", pose=None)),
     "2 wrench topics.*one topic of each kind.*--topic wrench=TOPIC"),
    (lambda bag: (pulled(bag), pulled(bag, wrench=None, pose="/left")), "--topic pose=TOPIC"),
    (lambda bag: pulled(bag, shift=3600.0), "3600 s apart.*--bag-clock log"),
])
def test_what_a_bag_lacks_is_said(tmp_path, bare_folder, made, told):
    with Written(tmp_path / "bad.mcap") as bag:
        made(bag)
    with pytest.raises(InputError, match=f"(?s){told}"):
        ImportPull(branch_folder=bare_folder, source=tmp_path / "bad.mcap", name="bad").run()
    assert not (bare_folder / "pulls" / "bad" / "pull.toml").exists()


@pytest.mark.slow
def test_what_was_asked_can_be_answered(tmp_path, bare_folder):
    with Written(tmp_path / "two.mcap") as bag:
        pulled(bag, shift=3600.0)
        pulled(bag, wrench="/other", pose="/left")
    ImportPull(branch_folder=bare_folder, source=tmp_path / "two.mcap", name="two",
               topic=("wrench=/wrench", "pose=/left"), bag_clock="log").run()
    pull = read_pull(bare_folder / "pulls" / "two")
    assert np.allclose(pull.wrenches[:, 0], 50 * pull.poses[:, 0], atol=1e-6)


@pytest.mark.slow
@pytest.mark.usefixtures("apart")
def test_damaged_bags_are_refused_or_read_never_crash(mcap, tmp_path, bare_folder):
    """Five ways of spoiling bytes: an answer in words each time, in seconds."""
    whole = mcap.read_bytes()
    rng = np.random.default_rng(8)
    answers = []
    for number in range(5):
        spoilt = bytearray(whole)
        if number % 3 == 0:
            spoilt = spoilt[:int(rng.integers(10, len(whole)))]
        else:
            for place in rng.integers(0, len(whole), 1 if number % 3 == 1 else 40):
                spoilt[place] = int(rng.integers(256))
        path = tmp_path / f"bad{number}.mcap"
        path.write_bytes(bytes(spoilt))
        try:
            read_bag(path)
            answers.append("read")
        except InputError as error:
            assert len(str(error)) < 1500
            answers.append("refused")
    assert "refused" in answers


def test_a_killed_recorders_folder_has_no_index(tmp_path, bare_folder):
    """Two files without metadata.yaml, the second without an end."""
    folder = tmp_path / "run"
    folder.mkdir()
    for number, shift in enumerate((0.0, 2.02)):
        with Written(folder / f"run_{number}.mcap", use_chunking=False) as bag:
            for time in np.linspace(1.0, 3.0, 101) + shift:
                bag.wrench("/wrench", time, [2.5 * (time - 1.0), 0.0, 0.0])
                bag.pose("/pose", time, [0.05 * (time - 1.0), 0.0, 0.5])
    last = folder / "run_1.mcap"
    last.write_bytes(last.read_bytes()[:-6000])
    result = ImportPull(branch_folder=bare_folder, source=folder, name="cut").run()
    assert result["kind"] == "bag"
    pull = read_pull(bare_folder / "pulls" / "cut")
    assert 101 < len(pull.times) <= 202
    assert np.allclose(pull.wrenches[:, 0], 50 * pull.poses[:, 0], atol=1e-6)


def test_a_bag_of_no_whole_message_names_the_tool(tmp_path):
    with Written(tmp_path / "a.mcap", use_chunking=False) as bag:
        bag.wrench("/wrench", 1.0, [1.0, 0.0, 0.0])
    content = (tmp_path / "a.mcap").read_bytes()
    (tmp_path / "a.mcap").write_bytes(content[:content.index(b"test") + 400])
    with pytest.raises(ValueError, match="no whole message; `mcap recover`"):
        bag_arrays(tmp_path / "a.mcap")


def test_a_robots_log_alone_is_a_pull(tmp_path, bare_folder):
    """As ur-rtde records it: actual_TCP_pose_0, ..., no markers; a base in another frame."""
    times = np.linspace(0, 2, 101)
    rows = np.zeros((101, 13))
    rows[:, 0], rows[:, 1], rows[:, 3], rows[:, 7] = times, 0.05 * times, 0.5, 2.5 * times
    header = ",".join(["timestamp", *(f"actual_TCP_pose_{k}" for k in range(6)),
                       *(f"actual_TCP_force_{k}" for k in range(6))])
    np.savetxt(tmp_path / "rtde.csv", rows, "%.9g", ",", header=header, comments="")
    result = ImportPull(branch_folder=bare_folder, source=tmp_path / "rtde.csv", name="log",
                        frame_pose=(0.1, 0, 0, 0, 0, np.pi / 2)).run()
    assert result["kind"] == "robot"
    pull = read_pull(bare_folder / "pulls" / "log")
    assert np.allclose(pull.poses[-1, :3], [0.1, 0.1, 0.5])
    assert np.allclose(pull.wrenches[-1, :3], [0, 5.0, 0], atol=1e-9)
    assert pull.entry.observation == "none"


def test_drop_a_bag_get_a_modulus(branch_folder, tmp_path, monkeypatch):
    """One command imports the bag under a name of its own, and estimates from it."""
    pull = read_pull(branch_folder / "pulls" / "pull-1")
    write_mcap(tmp_path / "run 7.mcap", branch_folder / "pulls" / "pull-1", pull)
    monkeypatch.setattr(stage, "_estimate", lambda _branch, asked, _: {"used": asked.pull})
    told = stage.EstimateYoung(branch_folder=branch_folder, bag=tmp_path / "run 7.mcap").run()
    assert told == {"used": ("run-7",)}
    again = read_pull(branch_folder / "pulls" / "run-7")
    assert np.allclose(again.wrenches[:, :3], pull.wrenches[:, :3], atol=1e-6)
    assert np.allclose(again.observations.positions, pull.observations.positions, atol=1e-7)
    # How well its cell is known comes along: without it the interval would be that of any robot.
    for part in ("calibration", "sensor", "grasp", "rest_points_m", "truth", "gravity_m_s2"):
        assert getattr(again.entry, part) == getattr(pull.entry, part), part


@pytest.mark.slow
def test_how_well_the_robot_is_known_comes_from_its_cell_or_is_said(tmp_path, bare_folder):
    with Written(tmp_path / "theirs.mcap") as bag:
        pulled(bag)
    said: list[str] = []
    ImportPull(branch_folder=bare_folder, source=tmp_path / "theirs.mcap",
               name="unknown").run(Progress(on_warning=said.append))
    assert any("calibration errors of gripper and force sensor" in line and "--cell" in line
               for line in said)
    assert read_pull(bare_folder / "pulls" / "unknown").entry.calibration is None
    write_cell(tmp_path / "cell.toml", Cell(
        robot={"model": "ur5e", "pose_sigma_m": 2e-5}, base={
            "pose": (0,) * 6, "position_sigma_m": 4e-4, "rotation_sigma_rad": 3e-3},
        sensor={"force_sigma_n": 0.3, "drift_n_per_minute": 6.0}))
    ImportPull(branch_folder=bare_folder, source=tmp_path / "theirs.mcap", name="known",
               cell=str(tmp_path / "cell.toml")).run()
    entry = read_pull(bare_folder / "pulls" / "known").entry
    assert entry.sensor.force_sigma_n == 0.3
    assert entry.calibration.force_drift_sigma_n == pytest.approx(0.2, rel=1e-3)
    assert entry.calibration.pose_sigma_m == 4e-4 and entry.calibration.pose_noise_m == 2e-5
    # When the sensor was tared a bag does not say.
    assert entry.calibration.force_bias_sigma_n == CalibrationEntry().force_bias_sigma_n


@pytest.mark.slow
def test_a_broken_description_in_a_bag_costs_only_itself(mcap, tmp_path, bare_folder, plain_pull,
                                                         monkeypatch):
    monkeypatch.setattr(bag_pull, "entry_text", lambda entry: "grasp = {radius_m = -1}")
    write_mcap(tmp_path / "odd.mcap", tmp_path / "spring", plain_pull)
    said: list[str] = []
    ImportPull(branch_folder=bare_folder, source=tmp_path / "odd.mcap",
               name="odd").run(Progress(on_warning=said.append))
    assert any("odd.mcap, metadata limber" in line for line in said)
    assert len(read_pull(bare_folder / "pulls" / "odd").times) == len(plain_pull.times)


# Bags whose first messages have no time, as drivers publish them before their clock is set.

REPORTED = (Path(__file__).parents[3] / "shared" / "data" / "reports" / "13-mcap-zero-stamps"
            / "zero5.mcap")
COUNT, EPOCH = 20, 1.7e9
LOGGED = EPOCH + 0.25 * np.arange(COUNT)


def bag(stamps, logged=LOGGED, kind="pose"):
    topic = Topic("/a", "branch", np.array(stamps, float), np.array(logged, float),
                  np.arange(7.0 * COUNT).reshape(COUNT, 7))
    return Bag(Path("a.mcap"), {kind: (topic,)}, (), 0)


@pytest.mark.parametrize("clock", ["header", "log"])
def test_the_reported_bag(tmp_path, clock):
    """A pull of about 5 s, with a word on what was left out."""
    pytest.importorskip("rosbags")
    if not REPORTED.exists():
        pytest.skip("the reports are not beside this checkout")
    found = pull_of_bag(read_bag(REPORTED), ImportRequest(
        REPORTED, tmp_path, settings=ImportSpec(bag_clock=clock)))
    assert found.robot.times[-1] == pytest.approx(5.2, abs=0.1) and len(found.robot.times) == 21
    assert sum("have a time of 0" in text for text in found.warnings) == 3


@pytest.mark.parametrize("bad", [[0, 1, 2], [7], [0, 10, 19]])
@pytest.mark.parametrize("value", [0.0, 12.5, EPOCH - 1e6, np.nan])
def test_times_that_cannot_be_are_left_out(bad, value):
    """Zeros, a clock that is set later, none: at the start, in the middle, at the end."""
    stamps, warnings = LOGGED + 0.01, []
    stamps[bad] = value
    topic, = stamped(bag(stamps), "stamps", warnings).of("pose")
    np.testing.assert_array_equal(topic.stamps, np.delete(LOGGED + 0.01, bad))
    assert topic.values.shape == (COUNT - len(bad), 7) and f"{len(bad)} of 20" in warnings[0]


@pytest.mark.parametrize("stamps", [LOGGED, LOGGED + 9e6, 0.25 * np.arange(COUNT)])
def test_clocks_of_their_own_stay(stamps):
    """Another zero of time is no fault; one that begins with 0 neither."""
    warnings = []
    topic, = stamped(bag(stamps), "stamps", warnings).of("pose")
    assert len(topic.stamps) == COUNT and not warnings


def test_a_topic_without_times_is_refused():
    with pytest.raises(InputError, match="--bag-clock log"):
        stamped(bag(np.zeros(COUNT)), "stamps", [])
    assert len(stamped(bag(np.zeros(COUNT), kind="camera"), "stamps", []).of("camera"))
