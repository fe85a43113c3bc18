"""The file that passes a session's frames: memory-mapped, one writer, any number of readers.

Little-endian; a reader needs only numpy and mmap.

=======  =====================  ==========================================================
offset   type                   what
=======  =====================  ==========================================================
0        8 bytes                ``LIMBPOS2``
8        uint32                 vertex_count n
12       uint32                 face_count f
16       uint32                 slot_count (3)
20       uint32                 number_count (32)
24       uint32                 grasp_count g (8), rows for grasps
28       uint32                 target_count t
40       uint64                 sequence: number of frames published so far
48       uint64                 offset of the faces, int32 [f, 3], outward
56       uint64                 offset of the first slot
64       uint64                 bytes of a slot
=======  =====================  ==========================================================

Frame number s (1, 2, ...) is in slot ``s % slot_count``, one after the other:

- number_count float64 (NUMBERS, in that order, the rest 0);
- g rows of 13 float64: number of the grasp (0: an empty row), its pose [m, rad], force [N] and
  torque [Nm] of the gripper on the branch;
- t rows of 3 float64: positions of the targets [m], in the order of ``hello``;
- n rows of 3 float32: positions [m];
- n float32: largest principal strain of the tetrahedra about a vertex.

To read: take the sequence s, copy slot s % slot_count, take the sequence again; if it has grown by
slot_count - 1 or more meanwhile, the copy may be torn: read again. Vertices are the mesh's surface
nodes in ascending order, as in ``frames/*.pc2``.
"""

import mmap
import os
from dataclasses import dataclass, field
from enum import IntEnum
from pathlib import Path

import numpy as np

from limber.core.errors import InputError
from limber.session.protocol import GRASP_LIMIT

MAGIC = b"LIMBPOS2"
SLOTS = 3
NUMBERS = ("id", "status", "is_trusted", "is_converged", "is_reached", "is_reduced", "energy_j",
           "force_x_n", "force_y_n", "force_z_n", "torque_x_nm", "torque_y_nm", "torque_z_nm",
           "delay_s", "kinetic_energy_j", "time_s", "greatest_strain", "strain_x_m", "strain_y_m",
           "strain_z_m", "min_det_f", "gravity_on", "sag_m")
_NUMBER_COUNT = 32
_GRASP_COLUMNS = 13
_HEADER = 128
_SEQUENCE_AT = 40


class Status(IntEnum):
    """The model that answers, and whether its answer is reliable."""

    learning = 1
    """The full model, slowly, while a reduced model is being learnt."""
    reduced = 2
    """The reduced model, within its training."""
    full = 3
    """The full model; no reduced one is being trained for this grasp."""
    untrusted = 4
    """An unreliable answer: no equilibrium, or outside the training."""


@dataclass(frozen=True)
class HeldAt:
    """A grasp in a frame: its pose and the force of the gripper.

    Attributes:
        number: Number of the grasp, from 1.
        pose: [m, rad], shape [6].
        force, torque: Force and torque of the gripper on the branch [N, Nm], shape [3].
    """

    number: int
    pose: np.ndarray
    force: np.ndarray
    torque: np.ndarray


@dataclass(frozen=True)
class Frame:
    """An answer of a session.

    Attributes:
        sequence: Number of the frame, from 1.
        positions: Surface positions [m], shape [vertex_count, 3], float32.
        strains: Largest principal strain about each vertex, shape [vertex_count], float32.
        move_id: The ``move`` that it answers.
        status: The model that answers, and whether its answer is reliable.
        is_reduced: From the reduced model; else from the full one.
        is_trusted: The model is within its training and at the requested pose.
        is_converged: An equilibrium was found (in motion: the step was).
        is_reached: The grasps have reached the requested poses; else they are on the path to them.
        energy: Potential of strain and weight above the hanging branch [J]; its gradient to the
            pose is the gripper's force. kinetic_energy: [J].
        reaction_force, reaction_torque: Those of the first gripper on the branch [N, Nm], shape
        [3].
        delay: From the worker's receipt of the command to the publication [s].
        time: Time of the simulated motion [s]; 0 in statics.
        greatest_strain: Largest principal strain anywhere; ``strain_place`` [m], shape [3]: its
            position on the bent branch.
        min_det_f: Smallest volume relative to that at rest; at 0 an element is inverted.
        gravity_on: Whether the branch's weight acts.
        sag: Largest displacement along gravity [m].
        grasps: All grasps.
        targets: Positions of the targets [m], shape [t, 3].
    """

    sequence: int
    positions: np.ndarray
    strains: np.ndarray
    move_id: int
    status: Status
    is_reduced: bool
    is_trusted: bool
    is_converged: bool
    is_reached: bool
    energy: float
    kinetic_energy: float
    reaction_force: np.ndarray
    reaction_torque: np.ndarray
    delay: float
    time: float
    greatest_strain: float
    strain_place: np.ndarray
    min_det_f: float
    gravity_on: bool
    sag: float
    grasps: tuple[HeldAt, ...] = ()
    targets: np.ndarray = field(default_factory=lambda: np.empty((0, 3)))


@dataclass(frozen=True)
class _Layout:
    """The layout of the file; ``counts`` is vertices, faces, slots, numbers, grasps, targets."""

    counts: tuple[int, int, int, int, int, int]
    faces_at: int
    slots_at: int
    slot_bytes: int

    @classmethod
    def of(cls, vertex_count: int, face_count: int, target_count: int) -> "_Layout":
        counts = (vertex_count, face_count, SLOTS, _NUMBER_COUNT, GRASP_LIMIT, target_count)
        slots_at = _HEADER + 12 * face_count
        slots_at += -slots_at % 64
        used = cls._used(counts)
        return cls(counts, _HEADER, slots_at, used + -used % 64)

    @staticmethod
    def _used(counts: tuple[int, int, int, int, int, int]) -> int:
        vertices, _, _, numbers, grasps, targets = counts
        return 8 * (numbers + _GRASP_COLUMNS * grasps + 3 * targets) + 16 * vertices

    @property
    def file_bytes(self) -> int:
        return self.slots_at + self.counts[2] * self.slot_bytes

    def fits(self, size: int) -> bool:
        """Whether a file of this many bytes can contain what the header states."""
        _, faces, slots, numbers, _, _ = self.counts
        return (slots >= 2 and numbers >= len(NUMBERS) and self.faces_at >= _HEADER
                and self.faces_at % 4 == 0 and self.slots_at % 8 == 0 and self.slot_bytes % 8 == 0
                and self.faces_at + 12 * faces <= self.slots_at
                and self._used(self.counts) <= self.slot_bytes and self.file_bytes <= size)


class _Slot:
    """Views of one slot of a mapped file."""

    def __init__(self, mapped: mmap.mmap, start: int, layout: _Layout):
        vertices, _, _, numbers, grasps, targets = layout.counts

        def view(kind: str, shape: tuple[int, ...]) -> np.ndarray:
            nonlocal start
            array = np.frombuffer(mapped, kind, int(np.prod(shape)), start).reshape(shape)
            start += array.nbytes
            return array

        self.numbers = view("<f8", (numbers,))
        self.grasps = view("<f8", (grasps, _GRASP_COLUMNS))
        self.targets = view("<f8", (targets, 3))
        self.positions = view("<f4", (vertices, 3))
        self.strains = view("<f4", (vertices,))


class FrameWriter:
    """Makes the file anew and publishes frames; ``faces`` [f, 3] are vertex indices."""

    def __init__(self, path: Path, faces: np.ndarray, vertex_count: int, target_count: int = 0):
        self.path = Path(path)
        faces = np.ascontiguousarray(faces, "<i4")
        layout = _Layout.of(vertex_count, len(faces), target_count)
        with open(self.path, "wb") as stream:
            stream.truncate(layout.file_bytes)
        self._file = open(self.path, "r+b")
        self._map = mmap.mmap(self._file.fileno(), 0)
        header = np.array([*layout.counts, 0, 0], "<u4").tobytes()
        header += np.array([0, layout.faces_at, layout.slots_at, layout.slot_bytes],
                           "<u8").tobytes()
        self._map[8:8 + len(header)] = header
        self._map[layout.faces_at:layout.faces_at + faces.nbytes] = faces.tobytes()
        self._map[0:8] = MAGIC
        self._slots = _slots(self._map, layout)
        self._sequence = np.frombuffer(self._map, "<u8", 1, _SEQUENCE_AT)

    def publish(self, positions: np.ndarray, *, strains: np.ndarray | None = None,
                grasps: tuple[HeldAt, ...] = (), targets: np.ndarray | None = None,
                **numbers: float) -> int:
        """Publish positions [m] with numbers of NUMBERS; return the frame's sequence number."""
        sequence = int(self._sequence[0]) + 1
        slot = self._slots[sequence % SLOTS]
        slot.numbers[:len(NUMBERS)] = [numbers.get(name, 0.0) for name in NUMBERS]
        slot.grasps[:] = 0.0
        for row, held in zip(slot.grasps, grasps, strict=False):
            row[:] = held.number, *held.pose, *held.force, *held.torque
        if targets is not None:
            slot.targets[:] = targets
        slot.positions[:] = positions
        slot.strains[:] = 0.0 if strains is None else strains
        # The counter is last: a reader that sees it sees the frame.
        self._sequence[0] = sequence
        return sequence

    def close(self) -> None:
        """Remove the file."""
        _release(self)
        self._map.close()
        self._file.close()
        self.path.unlink(missing_ok=True)


class FrameReader:
    """Reads the newest frame; rejects header sizes that the file cannot hold.

    Raises:
        InputError: the file is not a session's, has another version, or is truncated.
    """

    def __init__(self, path: Path):
        with open(path, "rb") as stream:
            size = os.fstat(stream.fileno()).st_size
            if size < _HEADER or stream.read(8) != MAGIC:
                raise InputError(f"{os.fspath(path)} is not a session's file.",
                                 f"It does not begin with {MAGIC.decode()}.",
                                 "Use the path of the session's `hello`, and Limber of one version"
                                 " on both sides.")
            self._map = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
        counts = np.frombuffer(self._map, "<u4", 6, 8).tolist()
        layout = _Layout(tuple(counts), *np.frombuffer(self._map, "<u8", 3, 48).tolist())
        if not layout.fits(size):
            self._map.close()
            raise InputError(f"{os.fspath(path)} of {size} bytes is cut short or damaged.",
                             "Its header states more data than the file contains.",
                             "Start a new session.")
        self.vertex_count, face_count = counts[:2]
        self.faces = np.frombuffer(self._map, "<i4", 3 * face_count, layout.faces_at
                                   ).reshape(-1, 3).copy()
        self._sequence = np.frombuffer(self._map, "<u8", 1, _SEQUENCE_AT)
        self._slots = _slots(self._map, layout)

    @property
    def sequence(self) -> int:
        """Number of frames published so far."""
        return int(self._sequence[0])

    def read(self) -> Frame | None:
        """Return the newest frame, or None if there is none yet."""
        while True:
            sequence = self.sequence
            if sequence == 0:
                return None
            slot = self._slots[sequence % len(self._slots)]
            copied = {name: array.copy() for name, array in vars(slot).items()}
            if self.sequence - sequence < len(self._slots) - 1:
                return _frame(sequence, **copied)

    def close(self) -> None:
        """Release the file."""
        _release(self)
        self._map.close()


def _slots(mapped: mmap.mmap, layout: _Layout) -> list[_Slot]:
    return [_Slot(mapped, layout.slots_at + k * layout.slot_bytes, layout)
            for k in range(layout.counts[2])]


def _release(owner: FrameReader | FrameWriter) -> None:
    # A memory map cannot be closed while arrays refer to it.
    owner._slots = []
    owner._sequence = np.zeros(1, "<u8")


def _frame(sequence: int, numbers: np.ndarray, grasps: np.ndarray, targets: np.ndarray,
           positions: np.ndarray, strains: np.ndarray) -> Frame:
    v = dict(zip(NUMBERS, numbers.tolist(), strict=False))
    held = tuple(HeldAt(int(row[0]), row[1:7], row[7:10], row[10:]) for row in grasps if row[0])
    return Frame(
        sequence, positions, strains, int(v["id"]), Status(int(v["status"]) or Status.untrusted),
        bool(v["is_reduced"]), bool(v["is_trusted"]), bool(v["is_converged"]),
        bool(v["is_reached"]), v["energy_j"], v["kinetic_energy_j"], numbers[7:10],
        numbers[10:13], v["delay_s"], v["time_s"], v["greatest_strain"], numbers[17:20],
        v["min_det_f"], bool(v["gravity_on"]), v["sag_m"], held, targets)
