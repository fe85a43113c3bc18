"""Bags as robots record them, for the fuzz: MCAP, rosbag2's folder, ROS 1."""

import atexit
import dataclasses
import shutil
import tempfile
from functools import cache, partial
from pathlib import Path
from typing import Any

from benchmarks.worker_branch_readers import Reader


def _mcap(template: Path, folder: Path) -> list[Path]:
    from limber.stages.pulls.export_pull import export_pull

    path = folder / "pull.mcap"
    export_pull(template, "pull-1", path)
    return [path]


def _bag(_template: Path, path: Path) -> Any:
    """A bag, up to the pull made from it."""
    from limber.recordings.bags.bag_pull import pull_of_bag
    from limber.recordings.bags.bag_reader import read_bag
    from limber.recordings.settings import ImportSettings

    with tempfile.TemporaryDirectory() as folder:
        made = pull_of_bag(read_bag(path), Path(folder), ImportSettings())
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


BAG_READERS: dict[str, Reader] = {
    "MCAP": Reader("binary", _mcap, _bag, True),
    "ROS 1 bag": Reader("binary", partial(_bag_part, "pull.bag"), _bag, True),
    "rosbag2 SQLite": Reader("binary", partial(_bag_part, ".db3"), partial(_bag_with, ".db3"),
                             True),
    "rosbag2 YAML": Reader("text", partial(_bag_part, "metadata.yaml"),
                           partial(_bag_with, "metadata.yaml"), True),
}
"""By name."""
