"""Files of laser scanners and of motion capture, for the fuzz of their readers."""

import struct
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.worker_branch_readers import Reader

_PAGE = 1024


def _points() -> np.ndarray:
    return np.random.default_rng(2).uniform(-1, 1, (60, 3)).round(4)


def _ptx(_template: Path, folder: Path) -> list[Path]:
    """Two scans, with a direction without a return."""
    path, head = folder / "scan.ptx", "60\n1\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n"
    matrix = "1 0 0 0\n0 1 0 0\n0 0 1 0\n0.5 0 0 1\n"
    rows = "".join(f"{x} {y} {z} 0.25 9 8 7\n" for x, y, z in _points()[1:]) + "0 0 0 0.5 0 0 0\n"
    path.write_text(2 * (head + matrix + rows))
    return [path]


def _e57(_template: Path, folder: Path) -> list[Path]:
    """One scan of plain numbers and one of scaled ones, each in its own file."""
    plain = "".join(f'<cartesian{axis} type="Float"/>' for axis in "XYZ")
    scaled = "".join(f'<cartesian{axis} type="ScaledInteger" minimum="-32768" maximum="32767" '
                     'scale="1e-4"/>' for axis in "XYZ")
    whole = (np.round(_points() * 1e4).astype(int) + 32768).astype("<u2")
    files = []
    for name, prototype, columns in (("plain", plain, _points()), ("scaled", scaled, whole)):
        streams = [np.ascontiguousarray(columns[:, k]).tobytes() for k in range(3)]
        packet = struct.pack("<4H", 3, *map(len, streams)) + b"".join(streams)
        packet += bytes(-len(packet) % 4)
        section = struct.pack("<BxxxxxxxQQQ", 1, 36 + len(packet), 80, 0) + struct.pack(
            "<BBH", 1, 0, len(packet) + 3) + packet
        text = ('<?xml version="1.0"?><e57Root><data3D><vectorChild><pose><translation><x>1</x>'
                '</translation></pose><points fileOffset="48" recordCount="60"><prototype>'
                f"{prototype}</prototype><codecs/></points></vectorChild></data3D></e57Root>")
        at = 48 + len(section)
        content = struct.pack("<8sIIQQQQ", b"ASTM-E57", 1, 0, 0, at // 1020 * _PAGE + at % 1020,
                              len(text), _PAGE) + section + text.encode()
        files.append(folder / f"{name}.e57")
        files[-1].write_bytes(_sealed(content))
    return files


def _sealed(content: bytes) -> bytes:
    """Pages with their checksums."""
    from limber.geometry.io.e57 import checksums

    inner = _PAGE - 4
    pages = np.frombuffer(content + bytes(-len(content) % inner), np.uint8).reshape(-1, inner)
    return np.hstack([pages, checksums(pages).astype(">u4")[:, None].view(np.uint8)]).tobytes()


def _read_e57(_template: Path, path: Path) -> Any:
    """Read a file with its checksums corrected, so that a fuzz's changes reach the reader."""
    from limber.geometry.io.clouds import read_points

    raw = path.read_bytes()
    pages = [raw[k:k + _PAGE - 4] for k in range(0, len(raw), _PAGE)]
    path.write_bytes(_sealed(b"".join(pages)))
    return read_points(path).points


def _read_cloud(_template: Path, path: Path) -> Any:
    from limber.geometry.io.clouds import read_points

    return read_points(path).points


def _capture(name: str, _template: Path, folder: Path) -> list[Path]:
    """Two markers as Motive, Vicon Nexus or Qualisys writes them."""
    mark = "\t" if name.endswith(".tsv") else ","
    rows = [mark.join(f"{1e3 * value:.3f}" for value in np.ravel(_points()[k:k + 2]))
            for k in range(50)]
    path, axes = folder / name, ",X,Y,Z,X,Y,Z\n"
    if name == "motive.csv":
        text = ("Format Version,1.23,Export Frame Rate,100,Length Units,Millimeters\n\n,Type"
                + 6 * ",Marker" + "\n,Name,A,A,A,B,B,B\n,ID" + 6 * ",1" + "\n," + 6 * ",Position"
                + "\nFrame,Time (Seconds)" + axes
                + "".join(f"{k},{k / 100:.3f},{row}\n" for k, row in enumerate(rows)))
    elif name == "vicon.csv":
        text = ("Trajectories\n100\n,,S:A,,,S:B,,\nFrame,Sub Frame" + axes + "," + 6 * ",mm" + "\n"
                + "".join(f"{k},0,{row}\n" for k, row in enumerate(rows)))
    else:
        text = ("NO_OF_FRAMES\t50\nFREQUENCY\t100\nMARKER_NAMES\tA\tB\n"
                + "".join(f"{row}\n" for row in rows))
    path.write_text(text)
    return [path]


def _markers(_template: Path, path: Path) -> Any:
    from limber.recordings.tables import marker_stream

    return marker_stream(path)[0]


SCANNER_READERS: dict[str, Reader] = {
    "PTX": Reader("text", _ptx, _read_cloud), "E57": Reader("binary", _e57, _read_e57),
    "Motive CSV": Reader("text", partial(_capture, "motive.csv"), _markers, True),
    "Vicon CSV": Reader("text", partial(_capture, "vicon.csv"), _markers, True),
    "Qualisys TSV": Reader("text", partial(_capture, "qualisys.tsv"), _markers, True)}
"""Readers by name."""
