"""The file through which a session hands over frames: memory-mapped, one writer, any readers.

Little-endian; a reader needs nothing but numpy and mmap.

=======  =====================  ==========================================================
offset   type                   what
=======  =====================  ==========================================================
0        8 bytes                ``LIMBPOS1``
8        uint32                 vertex_count n
12       uint32                 face_count f
16       uint32                 slot_count (3)
20       uint32                 number_count (16)
24       uint64                 sequence: number of frames published so far
32       uint64                 offset of the faces, int32 [f, 3], outward
40       uint64                 offset of the first slot
48       uint64                 bytes of a slot
=======  =====================  ==========================================================

Frame number s (1, 2, ...) stands in slot ``s % slot_count``: 16 float64 numbers (NUMBERS, in that
order, the rest 0), then positions float32 [n, 3] in metres. To read: take the sequence s, copy
slot s % slot_count, take the sequence again; if it has grown by slot_count - 1 or more meanwhile,
the copy may be torn: read again. Vertices are the mesh's surface nodes in ascending order, as in
``frames/*.pc2``.
"""

import mmap
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from limber.errors import InputError

MAGIC = b"LIMBPOS1"
SLOTS = 3
NUMBERS = ("id", "is_reduced", "is_trusted", "is_converged", "energy_j", "force_x_n", "force_y_n",
           "force_z_n", "torque_x_nm", "torque_y_nm", "torque_z_nm", "delay_s", "kinetic_energy_j",
           "time_s")
_NUMBER_COUNT = 16
_HEADER = 64


@dataclass(frozen=True)
class Frame:
    """What a session answers.

    Attributes:
        sequence: Number of the frame, from 1.
        positions: Surface positions [m], shape [vertex_count, 3], float32.
        move_id: The ``move`` that it answers.
        is_reduced: From the reduced model; else from the full one.
        is_trusted: The model is within what it knows (always, for the full one).
        is_converged: An equilibrium was found (in motion: the step was).
        strain_energy, kinetic_energy: [J].
        reaction_force, reaction_torque: Of the gripper on the branch [N, Nm], shape [3].
        delay: From the worker's receipt of the move to the publication [s].
        time: Time of the simulated motion [s]; 0 in statics.
    """

    sequence: int
    positions: np.ndarray
    move_id: int
    is_reduced: bool
    is_trusted: bool
    is_converged: bool
    strain_energy: float
    kinetic_energy: float
    reaction_force: np.ndarray
    reaction_torque: np.ndarray
    delay: float
    time: float


class FrameWriter:
    """Creates the file and publishes frames.

    Args:
        path: The file; overwritten.
        faces: Triangles [f, 3] of vertex indices.
        vertex_count: Number of vertices.
    """

    def __init__(self, path: Path, faces: np.ndarray, vertex_count: int):
        self.path = Path(path)
        faces = np.ascontiguousarray(faces, "<i4")
        start = _HEADER + faces.nbytes + (-faces.nbytes) % 64
        slot = 8 * _NUMBER_COUNT + 12 * vertex_count
        slot += (-slot) % 64
        with open(self.path, "wb") as stream:
            stream.truncate(start + SLOTS * slot)
        self._file = open(self.path, "r+b")
        self._map = mmap.mmap(self._file.fileno(), 0)
        header = np.array([vertex_count, len(faces), SLOTS, _NUMBER_COUNT], "<u4").tobytes()
        header += np.array([0, _HEADER, start, slot], "<u8").tobytes()
        self._map[8:8 + len(header)] = header
        self._map[_HEADER:_HEADER + faces.nbytes] = faces.tobytes()
        self._map[0:8] = MAGIC
        self._slots = _slots(self._map, start, slot, vertex_count)
        self._sequence = np.frombuffer(self._map, "<u8", 1, 24)

    def publish(self, positions: np.ndarray, **numbers: float) -> int:
        """Publish positions [m] with numbers of NUMBERS; return the frame's sequence number."""
        sequence = int(self._sequence[0]) + 1
        values, vertices = self._slots[sequence % SLOTS]
        values[:len(NUMBERS)] = [numbers.get(name, 0.0) for name in NUMBERS]
        vertices[:] = positions
        # The counter last: who sees it sees the frame.
        self._sequence[0] = sequence
        return sequence

    def close(self) -> None:
        """Remove the file."""
        _release(self)
        self._map.close()
        self._file.close()
        self.path.unlink(missing_ok=True)


class FrameReader:
    """Reads the newest frame.

    Raises:
        InputError: the file is not a session's.
    """

    def __init__(self, path: Path):
        with open(path, "rb") as stream:
            self._map = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
        if self._map[:8] != MAGIC:
            raise InputError(f"{os.fspath(path)} is not a session's file.",
                             f"It does not begin with {MAGIC.decode()}.",
                             "Use the path of the session's `hello`.")
        self.vertex_count, face_count, _, _ = np.frombuffer(self._map, "<u4", 4, 8).tolist()
        _, faces, start, slot = np.frombuffer(self._map, "<u8", 4, 24).tolist()
        self.faces = np.frombuffer(self._map, "<i4", 3 * face_count, faces).reshape(-1, 3).copy()
        self._sequence = np.frombuffer(self._map, "<u8", 1, 24)
        self._slots = _slots(self._map, start, slot, self.vertex_count)

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
            values, vertices = self._slots[sequence % SLOTS]
            values, vertices = values.copy(), vertices.copy()
            if self.sequence - sequence < SLOTS - 1:
                return _frame(sequence, values, vertices)

    def close(self) -> None:
        """Let go of the file."""
        _release(self)
        self._map.close()


def _slots(mapped: mmap.mmap, start: int, size: int, vertex_count: int,
           ) -> list[tuple[np.ndarray, np.ndarray]]:
    return [(np.frombuffer(mapped, "<f8", _NUMBER_COUNT, start + k * size),
             np.frombuffer(mapped, "<f4", 3 * vertex_count, start + k * size + 8 * _NUMBER_COUNT
                           ).reshape(-1, 3)) for k in range(SLOTS)]


def _release(owner: FrameReader | FrameWriter) -> None:
    # A memory map cannot be closed while arrays look into it.
    owner._slots = []
    owner._sequence = np.zeros(1, "<u8")


def _frame(sequence: int, values: np.ndarray, positions: np.ndarray) -> Frame:
    v = dict(zip(NUMBERS, values.tolist(), strict=False))
    return Frame(
        sequence, positions, int(v["id"]), bool(v["is_reduced"]), bool(v["is_trusted"]),
        bool(v["is_converged"]), v["energy_j"], v["kinetic_energy_j"], values[5:8], values[8:11],
        v["delay_s"], v["time_s"])
