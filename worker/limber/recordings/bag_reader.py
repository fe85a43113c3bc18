"""The content of a bag that belongs to a pull, as arrays from wrenches to images.

Read by the `rosbags` package in a separate process (:mod:`limber.geometry.io.isolated_readers`),
since bags may be untrusted. Messages that cannot be decoded are skipped and counted; a file with
many of them is refused.
"""

import struct
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from limber.core.errors import InputError, Option
from limber.core.numerics.rigid import inverted, matrices, poses_at
from limber.core.optional import require_extra
from limber.geometry.io.isolated_readers import read_apart

LIMBER, PULL_TOML = "limber", "pull.toml"
"""Name of the MCAP metadata record of an exported pull, and its entry with ``pull.toml``."""

_MOST_TEXT = 1_000_000
_MOST_BROKEN = 0.1
_SEPARATOR = "|"


@dataclass(frozen=True)
class Topic:
    """Messages of one topic, or of one pair of frames of a transform (``topic parent>child``):
    header and recording times [s], shape [n], and content, shape [n, ...]. ``labels`` are joints,
    an image's encoding or a transform's child, ``counts`` the points of each message if they
    vary."""

    name: str
    frame: str
    stamps: np.ndarray
    logged: np.ndarray
    values: np.ndarray
    labels: tuple[str, ...] = ()
    counts: np.ndarray | None = None


@dataclass(frozen=True)
class Bag:
    """Content of a bag: topics by kind (``wrench``, ``pose``, ``transform``, ``joints``,
    ``points``, ``image``, ``camera``), ``others`` as ``topic (type)``, the number of ``broken``
    messages, Limber's description of the pull if Limber wrote the bag, and what a user should know
    about the file."""

    path: Path
    kinds: dict[str, tuple[Topic, ...]]
    others: tuple[str, ...]
    broken: int
    pull_toml: str = ""
    notes: tuple[str, ...] = ()

    def of(self, kind: str) -> tuple[Topic, ...]:
        """Return the topics of a kind."""
        return self.kinds.get(kind, ())


def read_bag(path: Path) -> Bag:
    """Read a bag. MissingDependencyError without the package; InputError if it is damaged, or none
    of its messages can be decoded."""
    require_extra("bags", ("rosbags",), f"Reading {path.name}")
    arrays = read_apart(bag_arrays, path)
    kinds: dict[str, list[Topic]] = {}
    for number in range(int(arrays["topic_count"])):
        def part(name: str, number: int = number) -> np.ndarray:
            return arrays[f"{number}_{name}"]

        name, kind, frame, *labels = str(part("names")).split(_SEPARATOR)
        kinds.setdefault(kind, []).append(Topic(
            name, frame, part("stamps"), part("logged"), part("values"), tuple(labels),
            arrays.get(f"{number}_counts")))
    read, broken = int(arrays["read"]), int(arrays["broken"])
    if broken > _MOST_BROKEN * (read + broken):
        raise InputError(f"{path}: {broken} of {read + broken} messages cannot be decoded.",
                         "Too few remain for a recording.", "Record or export it again.")
    others = tuple(str(entry) for entry in arrays["others"])
    return Bag(path, {kind: tuple(topics) for kind, topics in kinds.items()}, others, broken,
               str(arrays["pull_toml"]), tuple(map(str, arrays["notes"])))


@dataclass
class _Growing:
    """A topic while it is being read."""

    kind: str
    frame: str
    labels: tuple[str, ...] = ()
    stamps: list[float] = field(default_factory=list)
    logged: list[float] = field(default_factory=list)
    values: list[np.ndarray] = field(default_factory=list)

    def arrays(self, name: str) -> dict[str, np.ndarray]:
        found = {"names": np.array(_SEPARATOR.join(part.replace(_SEPARATOR, "/") for part in (
                    name, self.kind, self.frame, *self.labels))),
                 "stamps": np.array(self.stamps), "logged": np.array(self.logged)}
        if len({values.shape for values in self.values}) == 1:
            return found | {"values": np.stack(self.values)}
        if self.kind != "points":
            raise ValueError(f"messages of {name} differ in shape")
        return found | {"counts": np.array([len(values) for values in self.values]),
                        "values": np.concatenate(self.values)}


_MAGIC = b"\x89MCAP0\r\n"
_FOOTER, _MESSAGE, _CHUNK, _DATA_END = 2, 5, 6, 15
_KEPT = (1, 3, 4, _MESSAGE, 12)
"""Kinds of MCAP's records: header, schema, channel, message, metadata."""


def recovered(path: Path, target: Path) -> tuple[int, int]:
    """Write the whole messages of an MCAP file without an end, as a killed recorder leaves it, into
    ``target``: their number, and the bytes behind the last one. ValueError without any."""
    count, cut = 0, [0]
    with open(target, "wb") as stream:
        stream.write(_MAGIC)
        for kind, record in _whole_records(path.read_bytes(), len(_MAGIC), cut):
            if kind in _KEPT:
                stream.write(struct.pack("<BQ", kind, len(record)) + record)
                count += kind == _MESSAGE
        for kind, length in ((_DATA_END, 4), (_FOOTER, 20)):
            stream.write(struct.pack("<BQ", kind, length) + bytes(length))
        stream.write(_MAGIC)
    if not count:
        raise ValueError("it has no whole message; `mcap recover` may find some")
    return count, cut[0]


def _whole_records(content: bytes, at: int, cut: list[int]) -> Iterator[tuple[int, bytes]]:
    """The kind and content of each whole record, also those in chunks; ``cut`` counts bytes of one
    that was not finished. The last chunk may be cut: what can be unpacked of it counts."""
    while at + 9 <= len(content):
        kind, length = struct.unpack_from("<BQ", content, at)
        record = content[at + 9:at + 9 + length]
        at += 9 + length
        if kind == _DATA_END:
            return
        if kind == _CHUNK and len(record) > 40:
            size, = struct.unpack_from("<I", record, 28)
            method = record[32:32 + size].decode("ascii", "replace")
            inner = _unpacked(method, record[40 + size:])
            cut[0] += 0 if inner or len(record) == length else len(record)
            yield from _whole_records(inner, 0, cut)
        elif len(record) == length:
            yield kind, record
        else:
            cut[0] += len(record)
    cut[0] += max(len(content) - at, 0)


def _unpacked(method: str, packed: bytes) -> bytes:
    """The content of a chunk, or of its beginning."""
    if method == "zstd":
        import zstandard

        return zstandard.ZstdDecompressor().decompressobj().decompress(packed)
    if method == "lz4":
        import lz4.frame

        return lz4.frame.LZ4FrameDecompressor().decompress(packed)
    return packed


def _files_of(path: Path) -> list[Path]:
    """The bag itself; of a folder without an index, which a killed recorder does not write, its
    files."""
    if not path.is_dir() or (path / "metadata.yaml").is_file():
        return [path]
    return sorted(each for each in path.iterdir() if each.suffix in (".mcap", ".db3"))


def is_bag(path: Path) -> bool:
    """Return whether a folder is a bag, also one without its index."""
    return path.is_dir() and bool(_files_of(path))


def bag_arrays(path: Path) -> dict[str, np.ndarray]:
    """Return the content of a bag as flat arrays, for :func:`read_bag` in the parent process."""
    files = _files_of(path)
    notes = [] if files == [path] else [
        f"{path.name} has no metadata.yaml: its recorder was stopped. Its {len(files)} file(s) "
        "were read."]
    with tempfile.TemporaryDirectory(prefix="limber-bag-") as folder:
        for number, file in enumerate(files):
            if file.suffix.lower() == ".mcap" and not file.read_bytes().endswith(_MAGIC):
                files[number] = Path(folder, f"{number}.mcap")
                count, cut = recovered(file, files[number])
                notes.append(f"{file.name} has no end: its recorder was stopped. Its {count} whole "
                             "messages were read" + (f", {cut} bytes behind them were not."
                                                     if cut else "."))
        return _content(files, notes)


def _content(files: Sequence[Path], notes: Sequence[str]) -> dict[str, np.ndarray]:
    """The content of files of one bag."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    found: dict[str, _Growing] = {}
    others: list[str] = []
    read = broken = 0
    with AnyReader(files, default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        connections = []
        for connection in reader.connections:
            if connection.msgtype in _READERS:
                connections.append(connection)
            else:
                others.append(f"{connection.topic} ({connection.msgtype})")
        for connection, logged, raw in reader.messages(connections=connections):
            try:
                message = reader.deserialize(raw, connection.msgtype)
                entries = _READERS[connection.msgtype](message)
            except Exception:  # the decoder raises any error; it is counted and reported
                broken += 1
                continue
            read += 1
            for suffix, kind, header, values, labels in entries:
                name = f"{connection.topic}{suffix}"
                topic = found.setdefault(name, _Growing(kind, header.frame_id, labels))
                topic.stamps.append(header.stamp.sec + 1e-9 * header.stamp.nanosec)
                topic.logged.append(1e-9 * logged)
                topic.values.append(values)
    arrays: dict[str, np.ndarray] = {
        "topic_count": np.array(len(found)), "read": np.array(read), "broken": np.array(broken),
        "others": np.array(others, "U200"), "points": np.zeros((0, 3)),
        "pull_toml": np.array(_pull_toml(files[0])), "notes": np.array(notes, "U400")}
    for number, (name, topic) in enumerate(found.items()):
        arrays |= {f"{number}_{key}": array for key, array in topic.arrays(name).items()}
    return arrays


def _pull_toml(path: Path) -> str:
    """The description that `limber export-pull` writes beside the messages; empty if there is none.
    """
    if path.suffix.lower() != ".mcap":
        return ""
    from mcap.exceptions import McapError
    from mcap.reader import make_reader

    try:
        with open(path, "rb") as stream:
            for record in make_reader(stream).iter_metadata():
                if record.name == LIMBER:
                    return record.metadata.get(PULL_TOML, "")[:_MOST_TEXT]
    except (McapError, OSError, ValueError):
        # The file is truncated before the index of such records; the messages were read.
        return ""
    return ""


_Entry = tuple[str, str, Any, np.ndarray, tuple[str, ...]]


def _wrench(message: Any) -> list[_Entry]:
    force, torque = message.wrench.force, message.wrench.torque
    return [("", "wrench", message.header, np.array(
        [force.x, force.y, force.z, torque.x, torque.y, torque.z]), ())]


def _pose(message: Any) -> list[_Entry]:
    pose = message.pose
    return [("", "pose", message.header, _seven(pose.position, pose.orientation), ())]


def _transform(message: Any) -> list[_Entry]:
    moved = message.transform
    child = message.child_frame_id
    return [(f" {message.header.frame_id}>{child}", "transform", message.header,
             _seven(moved.translation, moved.rotation), (child,))]


def _transforms(message: Any) -> list[_Entry]:
    return [entry for each in message.transforms for entry in _transform(each)]


def _joints(message: Any) -> list[_Entry]:
    return [("", "joints", message.header, np.array(message.position, float),
             tuple(message.name))]


def _cloud(message: Any) -> list[_Entry]:
    """Coordinates [m] of a PointCloud2, shape [n, 3]; NaN for invalid points."""
    kinds = {field.name: (field.offset, {7: "f4", 8: "f8"}[field.datatype])
             for field in message.fields if field.name in ("x", "y", "z")}
    order = ">" if message.is_bigendian else "<"
    layout = np.dtype({"names": ["x", "y", "z"],
                       "formats": [order + kinds[axis][1] for axis in "xyz"],
                       "offsets": [kinds[axis][0] for axis in "xyz"],
                       "itemsize": message.point_step})
    rows = np.asarray(message.data, np.uint8).tobytes()
    count = message.width * message.height
    points = np.frombuffer(rows, layout, count)
    return [("", "points", message.header,
             np.column_stack([points[axis].astype(float) for axis in "xyz"]), ())]


_PIXELS = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}


def _image(message: Any) -> list[_Entry]:
    """Depths as stored in the image; colour images are skipped."""
    if message.encoding not in _PIXELS:
        return []
    kind = np.dtype((">" if message.is_bigendian else "<") + _PIXELS[message.encoding])
    rows = np.asarray(message.data, np.uint8).reshape(message.height, message.step)
    pixels = np.ascontiguousarray(rows[:, :message.width * kind.itemsize]).view(kind)
    return [("", "image", message.header, pixels.astype(kind.newbyteorder("=")),
             (message.encoding,))]


def _camera(message: Any) -> list[_Entry]:
    matrix = getattr(message, "k", None)
    matrix = np.asarray(message.K if matrix is None else matrix, float)
    return [("", "camera", message.header, np.array(
        [message.width, message.height, matrix[0], matrix[4], matrix[2], matrix[5]]), ())]


def _seven(position: Any, turn: Any) -> np.ndarray:
    return np.array([position.x, position.y, position.z, turn.x, turn.y, turn.z, turn.w])


_READERS: dict[str, Callable[[Any], list[_Entry]]] = {
    "geometry_msgs/msg/WrenchStamped": _wrench,
    "geometry_msgs/msg/PoseStamped": _pose,
    "geometry_msgs/msg/TransformStamped": _transform,
    "tf2_msgs/msg/TFMessage": _transforms,
    "sensor_msgs/msg/JointState": _joints,
    "sensor_msgs/msg/PointCloud2": _cloud,
    "sensor_msgs/msg/Image": _image,
    "sensor_msgs/msg/CameraInfo": _camera,
}


# Messages whose header has no time, or an impossible one.

_OFF_S = 3600.0
"""Largest distance from the topic's other stamps that a clock's drift can explain."""


def stamped(bag: Bag, clock: str, warnings: list[str]) -> Bag:
    """Return a bag without messages whose time (``stamps`` or ``logged``) is 0 or far from the
    others of their topic, as drivers publish before their clock is set; static data keep theirs.
    Says so in ``warnings``; InputError if most of a topic's messages have no time."""
    return replace(bag, kinds={
        kind: tuple(_of_topic(bag, topic, clock, warnings) if kind != "camera"
                    and len(topic.stamps) > 2 else topic for topic in topics)
        for kind, topics in bag.kinds.items()})


def _of_topic(bag: Bag, topic: Topic, clock: str, warnings: list[str]) -> Topic:
    times = getattr(topic, clock)
    zero = times == 0
    known = np.isfinite(times) & (times > 0)
    if 2 * np.count_nonzero(known) <= len(times):
        other = "log" if clock == "stamps" else "header"
        raise InputError(
            f"{bag.path}: {int((~known).sum())} of {len(times)} messages of {topic.name} have no "
            f"time in their {'headers' if clock == 'stamps' else 'log'}.", "Their order in time is "
            "not known from there.", "Use the other times: ", Option("bag_clock", other), ".")
    # The other clock continues while a driver's is set.
    lead = topic.stamps - topic.logged
    good = known & (np.abs(lead - np.median(lead[known])) < _OFF_S)
    if zero.sum() == 1 and np.median(times[known]) < _OFF_S:
        # A separate clock starts at 0, for example that of a simulation.
        good |= zero
    if good.all():
        return topic
    warnings.append(f"{bag.path.name}: {int((~good).sum())} of {len(times)} messages of "
                    f"{topic.name} have a time of 0, or one far from the others. They were "
                    "discarded.")
    rows = good if topic.counts is None else np.repeat(good, topic.counts)
    return replace(topic, stamps=topic.stamps[good], logged=topic.logged[good],
                   values=topic.values[rows],
                   counts=None if topic.counts is None else topic.counts[good])


# Reference frames in a bag: the pose of one in another, from its transforms.

_MOST_LINKS = 32


@dataclass(frozen=True)
class Motion:
    """A frame in another over time [s], increasing, or a static one: poses [m, rad], [n, 6]."""

    times: np.ndarray
    poses: np.ndarray

    @classmethod
    def of(cls, times: np.ndarray, values: np.ndarray) -> "Motion":
        """Return it from rows of position and quaternion (x, y, z, w), [n, 7]."""
        good = (np.isfinite(values).all(axis=1) & np.isfinite(times)
                & (np.linalg.norm(np.nan_to_num(values[:, 3:]), axis=1) > 1e-6))
        times, first = np.unique(times[good], return_index=True)
        values = values[good][first]
        return cls(times, np.hstack([values[:, :3],
                                     Rotation.from_quat(values[:, 3:]).as_rotvec()]))

    def at(self, times: np.ndarray) -> np.ndarray:
        """Return its frames [n, 4, 4] at ``times``; outside their range the nearest known."""
        if len(self.times) == 1:
            return matrices(self.poses[[0] * len(times)])
        return matrices(poses_at(self.times, self.poses,
                                 np.clip(times, self.times[0], self.times[-1])))


class Frames:
    """All frames that a bag's transforms connect."""

    def __init__(self, topics: tuple[Topic, ...], clock: str):
        self._links: dict[str, dict[str, tuple[Motion, bool]]] = {}
        for topic in topics:
            # A static transform is often sent only once, at any time: its stamp does not count.
            motion = Motion.of(getattr(topic, clock), topic.values)
            parent, child = topic.frame.lstrip("/"), topic.labels[0].lstrip("/")
            if len(motion.times) and parent != child:
                self._links.setdefault(parent, {})[child] = (motion, False)
                self._links.setdefault(child, {})[parent] = (motion, True)

    @property
    def names(self) -> list[str]:
        """Every frame."""
        return sorted(self._links)

    def between(self, frame: str, within: str, times: np.ndarray) -> np.ndarray | None:
        """Return ``frame`` in ``within`` at ``times``, shape [n, 4, 4]; None if unknown."""
        chain = self._transform_chain(within.lstrip("/"), frame.lstrip("/"))
        if chain is None:
            return None
        found = np.tile(np.eye(4), (len(times), 1, 1))
        for motion, is_inverse in chain:
            found = found @ (inverted(motion.at(times)) if is_inverse else motion.at(times))
        return found

    def _transform_chain(self, start: str, end: str) -> list[tuple[Motion, bool]] | None:
        if start == end:
            return []
        reached: dict[str, list[tuple[Motion, bool]]] = {start: []}
        for _ in range(_MOST_LINKS):
            grown = {other: [*chain, link] for name, chain in reached.items()
                     for other, link in self._links.get(name, {}).items() if other not in reached}
            if not grown:
                return None
            reached |= grown
            if end in reached:
                return reached[end]
        return None
