"""Readers of the files of a branch folder and of bags of recordings, for the fuzz.

Each file is put into a copy of a branch folder with its checksums corrected, as an attacker would
do; then every function that shows it or computes with it is called.
"""

import atexit
import dataclasses
import json
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from limber.core.files.atomic import file_digest
from limber.store import Branch

TEMPLATE = Path(__file__).parents[2] / "blend_files" / "bending_branch"


@dataclass(frozen=True)
class Reader:
    """One kind of file that others may have written.

    Attributes:
        kind: Kind of mutation: ``text``, ``json``, ``npz``, ``binary``.
        make: Writes good files into a folder, from a template branch; returns them.
        read: Reads a file; gets the template as well.
        may_lack: Whether NaN stands for "not measured" there.
    """

    kind: str
    make: Callable[[Path, Path], list[Path]]
    read: Callable[[Path, Path], Any]
    may_lack: bool = False


def template_file(name: str, template: Path, folder: Path) -> list[Path]:
    """Copy a file of the template branch."""
    target = folder / Path(name).name
    shutil.copyfile(template / name, target)
    return [target]


@cache
def _work_copy(template: Path) -> Path:
    place = Path(tempfile.mkdtemp(prefix="limber-fuzz-branch-"))
    atexit.register(shutil.rmtree, place, ignore_errors=True)
    return Path(shutil.copytree(template, place / "work.branch"))


def _in_folder(name: str, act: Callable[[Branch], Any], template: Path, path: Path) -> Any:
    """Act on a branch whose file ``name`` is ``path``, with the right checksum."""
    work = _work_copy(template)
    kept = {file: (work / file).read_bytes() if (work / file).exists() else None
            for file in (name, "branch.json")}
    try:
        (work / name).parent.mkdir(exist_ok=True)
        (work / name).write_bytes(path.read_bytes())
        if name != "branch.json":
            manifest = json.loads(kept["branch.json"])
            entry = {"sha256": file_digest(path), "bytes": path.stat().st_size, "stage": "mesh"}
            manifest["files"][name] = manifest["files"].get(name, {}) | entry
            (work / "branch.json").write_text(json.dumps(manifest))
        return act(Branch.open(work))
    finally:
        for file, content in kept.items():
            if content is None:
                (work / file).unlink()
            else:
                (work / file).write_bytes(content)


def _shown(branch: Branch) -> Any:
    from limber.results.scene.animation import scene_data
    from limber.store.loading import load_targets

    data = scene_data(branch, targets=load_targets(branch))
    return {name: values for name, values in data.arrays.items()
            if not name.startswith("observation")}


def _computed(branch: Branch) -> Any:
    from limber.store.loading import load_branch, load_skeleton

    load_skeleton(branch)
    return load_branch(branch, gravity=False).model.mesh


def _shown_and_computed(branch: Branch) -> Any:
    return _shown(branch), _computed(branch)


def _masses(branch: Branch) -> Any:
    from limber.store.loading import load_masses, load_point_masses

    return load_masses(branch), load_point_masses(branch)


def _planned(branch: Branch) -> Any:
    """A plan's JSON and tables as scene and report show them."""
    from limber.planning.plan_file import read_plan
    from limber.stages.paths.plan import Plan

    plan = read_plan(branch.path("plans/to-goal.json"))
    Plan.of(plan.summary).comparison()
    return _shown(branch), plan.plan, plan.baseline, plan.motion


def _sampled(branch: Branch) -> Any:
    from limber.planning.field.energy_field import EnergyField

    field = EnergyField.read(branch.path("energy.npz"))
    return _shown(branch), field.energy(field.samples.positions[:3])


def _estimated(branch: Branch) -> Any:
    """An estimate as in the report, and as `limber predict` uses it up to its solve."""
    from limber.estimation.estimate_file import read_estimate
    from limber.results.report.report_tables import (
        cause_rows,
        deviation_rows,
        held_out_rows,
        modulus_rows,
    )

    known = read_estimate(branch.path("estimate.json"))
    modulus_rows(known, None), cause_rows(known), deviation_rows(known), held_out_rows(known)
    return known


def _pulled(branch: Branch) -> Any:
    from limber.recordings.recording import read_pull
    from limber.recordings.sensor_checks import clean

    return clean(read_pull(branch.path("pulls/pull-1"))), _shown(branch)


def _opened(branch: Branch) -> Any:
    branch.damages()
    return branch.gravity, _shown(branch)


def _made(name: str, text: str, _template: Path, folder: Path) -> list[Path]:
    path = folder / name
    path.write_text(text)
    return [path]


def _json_file(name: str, content: Any) -> Callable[[Path, Path], list[Path]]:
    return partial(_made, name, json.dumps(content))


_MASSES = [{"mass_kg": 0.01, "attached_m": [0, 0, 0.2], "centre_m": [0.01, 0, 0.22],
            "inertia_kg_m2": [[1e-6, 0, 0], [0, 1e-6, 0], [0, 0, 1e-6]]},
           {"mass_kg": 0.02, "attached_m": [0, 0, 0.3]}]
_TARGETS = {"format_version": 1, "targets": [
    {"name": "fruit", "position_m": [0.0, 0.0, 0.3], "mass_kg": 0.1}]}


def _search_file(template: Path, folder: Path) -> list[Path]:
    """A possible search result of the template's cloud, with a bit of everything."""
    from limber.geometry.cloud.leaves import Leaf
    from limber.geometry.io.clouds import read_points
    from limber.geometry.io.skeletons import read_skeleton
    from limber.geometry.skeleton.search_result import FoundSkeleton, result_of_skeleton

    found = result_of_skeleton(read_skeleton(template / "skeleton.csv"),
                               read_points(template / "cloud.ply").points[::10])
    place = np.array([0.1, 0.2, 0.3])
    found = replace(found, loops=[0.1], second_base=place, root_ends=[
        {"at": at, "probability": 0.5} for at in (place, 2 * place)], bridges=[
        {"from": place, "to": 2 * place, "length": 0.1, "price": 1.5}], split_off=[
        {"points": 3, "distance": 0.1, "at": place}], unlikely=[
        {"length": 0.01, "at": place, "probability": 0.2}])
    path = folder / "scan_skeleton.npz"
    FoundSkeleton(found, [Leaf(np.arange(3), 1e-3)]).write(path)
    return [path]


def _searched(branch: Branch) -> Any:
    """A search as reconstruct reuses it: moved, reported, and matched with points."""
    from limber.geometry.skeleton.search_result import FoundSkeleton

    found = FoundSkeleton.read(branch.path("scan_skeleton.npz")).result
    return found.moved(lambda points: points + 1.0).report(), found.warnings, found.residual


def _load(branch: Branch) -> Any:
    from limber.stages.motion.load import Load

    return Load.read(branch, "load:gale", {}).rows()


def _swing(branch: Branch) -> Any:
    from limber.results.report.figures import along_path
    from limber.stages.moduli.swing import Swing

    swing = Swing.read(branch, "swing", _SWING)
    return along_path(swing.seen, swing.simulated)


_LOAD = {"along": [{"from_m": 0.0, "to_m": 0.3, "strain": 0.001}],
         "tip_displacement_m": [0.01, 0, -0.02], "sag_m": 0.02, "sag_interval_m": [0.01, 0.03],
         "greatest_strain": 0.001, "greatest_strain_interval": [0.0008, 0.0012],
         "strain_over_limit": 0.1, "frequencies_hz": [2.0], "frequencies_before_hz": [2.5, 3.1],
         "first_frequency_interval_hz": [1.9, 2.1], "wind_force_n": [1, 0, 0], "added_mass_kg": 0.1,
         "cut_mass_kg": 0.0, "bears_times": 3.0, "bears_times_interval": [2.5, 3.5],
         "held_by": "strain", "gusts": {
             "factor": 1.5, "peak_factor": 3.2, "dynamic": 1.1, "damping": 0.03,
             "mean_speed_m_s": 5.0, "mean_tip_displacement_m": [0.01, 0, 0]}}
_TRACK = (0.02 * np.cos(np.linspace(0, 6, 12))[:, None, None] * [[[0, 0, 0.1], [0, 0.5, 1.0]]])
_SWING = {"pull": "let-go", "young_pa": 2.5e6, "young_interval_pa": [2.4e6, 2.7e6],
          "damping_ratio": 0.05, "damping_ratio_interval": [0.04, 0.06], "release_s": 0.4,
          "release_deviation_s": 0.01, "frequency_hz": 3.2, "relative_residual": 0.012,
          "warnings": ["a word"], "times_s": np.linspace(0, 1, 12).tolist(),
          "seen_m": _TRACK.tolist(), "simulated_m": _TRACK.tolist()}


def _branch_file(name: str, kind: str, act: Callable[[Branch], Any], make: Any = None,
                 may_lack: bool = False) -> Reader:
    return Reader(kind, make or partial(template_file, name), partial(_in_folder, name, act),
                  may_lack)


# --- bags as robots record them: MCAP, rosbag2's folder, ROS 1 ----------------------------------


def _mcap(template: Path, folder: Path) -> list[Path]:
    from limber.stages.pulls.export_pull import ExportPull

    path = folder / "pull.mcap"
    ExportPull(branch_folder=template, name="pull-1", mcap=path).run()
    return [path]


def _bag(_template: Path, path: Path) -> Any:
    """A bag, up to the pull made from it."""
    from limber.recordings.bag_pull import pull_of_bag
    from limber.recordings.bag_reader import read_bag
    from limber.recordings.import_request import ImportRequest

    with tempfile.TemporaryDirectory() as folder:
        made = pull_of_bag(read_bag(path), ImportRequest(path, Path(folder)))
    return made.robot, made.seen


@cache
def _recorded_bag(template: Path, kind: str) -> Path:
    """The template's pull as ROS records it: a folder with SQLite, or the one file of ROS 1."""
    from rosbags.highlevel import AnyReader

    place = Path(tempfile.mkdtemp(prefix="limber-fuzz-bag-"))
    atexit.register(shutil.rmtree, place, ignore_errors=True)
    if kind == "ros1":
        from rosbags.rosbag1 import Writer
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        types = get_typestore(Stores.ROS1_NOETIC)
        types.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms",
                                          "tf2_msgs/msg/TFMessage"))
        writer = Writer(place / "pull.bag")
    else:
        from rosbags.rosbag2 import Writer

        writer = Writer(place / "pull", version=9)
    with AnyReader(_mcap(template, place)) as reader, writer:
        known = {connection.topic: writer.add_connection(
            connection.topic, connection.msgtype,
            typestore=types if kind == "ros1" else reader.typestore)
            for connection in reader.connections}
        for connection, logged, raw in reader.messages():
            if kind == "ros1":
                message = reader.deserialize(raw, connection.msgtype)
                raw = types.serialize_ros1(_ros1(message, types), connection.msgtype)
            writer.write(known[connection.topic], logged, raw)
    return place / ("pull.bag" if kind == "ros1" else "pull")


def _ros1(message: Any, types: Any) -> Any:
    """A message as in ROS 1: its header counts as well."""
    parts = {part.name: getattr(message, part.name) for part in dataclasses.fields(message)
             if part.name != "__msgtype__"}
    kind = message.__msgtype__
    if kind == "std_msgs/msg/Header":
        parts["seq"] = 0
    made = {name: _ros1(value, types) if dataclasses.is_dataclass(value) else [
        _ros1(one, types) if dataclasses.is_dataclass(one) else one for one in value]
        if isinstance(value, list) else value for name, value in parts.items()}
    return types.types[kind](**made)


def _bag_part(name: str, template: Path, folder: Path) -> list[Path]:
    """One file of a recorded bag: ``pull.bag``, ``metadata.yaml`` or the SQLite file's suffix."""
    bag = _recorded_bag(template, "ros1" if name == "pull.bag" else "ros2")
    part = bag if bag.is_file() else next(bag.glob(f"*{name}"))
    return [Path(shutil.copyfile(part, folder / part.name))]


def _bag_with(name: str, template: Path, path: Path) -> Any:
    """A bag of ROS 2 one of whose files is ``path``."""
    with tempfile.TemporaryDirectory() as place:
        bag = Path(shutil.copytree(_recorded_bag(template, "ros2"), Path(place, "pull")))
        shutil.copyfile(path, next(bag.glob(f"*{name}")))
        return _bag(template, bag)


BRANCH_READERS: dict[str, Reader] = {
    "branch.json": _branch_file("branch.json", "json", _opened),
    "QSM CSV": _branch_file("skeleton.csv", "text", _shown_and_computed),
    "VTU": _branch_file("mesh.vtu", "text", _shown_and_computed),
    "scan_skeleton.npz": _branch_file("scan_skeleton.npz", "npz", _searched, _search_file),
    "cloud.ply": _branch_file("cloud.ply", "binary", _shown),
    "point_masses.json": _branch_file("point_masses.json", "json", _masses,
                                      _json_file("point_masses.json", _MASSES)),
    "targets.json": _branch_file("targets.json", "json", _shown_and_computed,
                                 _json_file("targets.json", _TARGETS)),
    "pull.toml": _branch_file("pulls/pull-1/pull.toml", "text", _pulled, may_lack=True),
    "robot.csv": _branch_file("pulls/pull-1/robot.csv", "text", _pulled, may_lack=True),
    "markers.csv": _branch_file("pulls/pull-1/markers.csv", "text", _pulled, may_lack=True),
    "estimate.json": _branch_file("estimate.json", "json", _estimated),
    "energy.npz": _branch_file("energy.npz", "npz", _sampled),
    "frames JSON": _branch_file("frames/to-goal.json", "json", _shown),
    "frames NPZ": _branch_file("frames/to-goal.npz", "npz", _shown),
    "PC2": _branch_file("frames/to-goal.pc2", "binary", _shown),
    "plan JSON": _branch_file("plans/to-goal.json", "json", _planned),
    "plan CSV": _branch_file("plans/to-goal.csv", "text", _planned),
    "loads JSON": _branch_file("loads/gale.json", "json", _load, _json_file("gale.json", _LOAD)),
    "swing.json": _branch_file("swing.json", "json", _swing, _json_file("swing.json", _SWING),
                               may_lack=True),
    "MCAP": Reader("binary", _mcap, _bag, True),
    "ROS 1 bag": Reader("binary", partial(_bag_part, "pull.bag"), _bag, True),
    "rosbag2 SQLite": Reader("binary", partial(_bag_part, ".db3"), partial(_bag_with, ".db3"),
                             True),
    "rosbag2 YAML": Reader("text", partial(_bag_part, "metadata.yaml"),
                           partial(_bag_with, "metadata.yaml"), True),
}
"""By name."""
