"""Files as scanners and motion capture write them, with what they hold: for tests and the fuzz."""

import struct

import numpy as np
from scipy.spatial.transform import Rotation

from limber.geometry.cloud.cloud import Cloud
from limber.geometry.io.e57 import checksums

CLOUD = np.random.default_rng(0).normal(size=(200, 3)).round(5)
POINTS = np.random.default_rng(5).uniform(-2, 2, (50, 3)).round(4)
TURN, SHIFT = Rotation.from_rotvec([0.2, -0.4, 1.1]), np.array([10.0, -4.0, 1.5])


def ptx(path, *, colour, silent=0, cut=0):
    """Two scans, the second turned and moved, with pixels that saw nothing."""
    lines = []
    for turn, shift in ((Rotation.identity(), np.zeros(3)), (TURN, SHIFT)):
        own = turn.inv().apply(POINTS - shift)
        matrix = np.eye(4)
        matrix[:3, :3], matrix[3, :3] = turn.as_matrix().T, shift
        rows = [" ".join(f"{v:.9f}" for v in point) + " 0.25" + (" 9 8 7" if colour else "")
                for point in own] + ["0 0 0 0.5" + (" 0 0 0" if colour else "")] * silent
        lines += [str(len(rows)), "1", "0 0 0", "1 0 0", "0 1 0", "0 0 1",
                  *(" ".join(f"{v:.12f}" for v in row) for row in matrix), *rows]
    path.write_text("\n".join(lines[:len(lines) - cut]) + "\n")


def packed(values, bits):
    """Whole numbers as E57 packs them: the lowest bit first."""
    held = sum(int(value) << (bits * k) for k, value in enumerate(values))
    return held.to_bytes((bits * len(values) + 7) // 8, "little")


FLOATS = ("".join(f'<cartesian{a} type="Float"/>' for a in "XYZ"),
          [POINTS[:, k].astype("<f8").tobytes() for k in range(3)])
SCALED = ("".join(f'<cartesian{a} type="ScaledInteger" minimum="-20000" maximum="20000" '
                  'scale="1e-4"/>' for a in "XYZ"),
          [packed(np.round(POINTS[:, k] * 1e4).astype(int) + 20000, 16) for k in range(3)])
WIDE = ("".join(f'<cartesian{a} type="ScaledInteger" minimum="{-2**60}" maximum="{2**60}" '
                'scale="1e-4"/>' for a in "XYZ"),
        [packed([int(v) + 2**60 for v in np.round(POINTS[:, k] * 1e4)], 62) for k in range(3)])
SPHERES = ("".join(f'<spherical{a} type="Float"/>' for a in ("Range", "Azimuth", "Elevation")),
           [column.astype("<f8").tobytes() for column in (
               np.linalg.norm(POINTS, axis=1), np.arctan2(POINTS[:, 1], POINTS[:, 0]),
               np.arcsin(POINTS[:, 2] / np.linalg.norm(POINTS, axis=1)))])


def e57(path, columns, extra=("", ()), pose=""):
    """One scan, its points in two packets that part each column's bytes anywhere."""
    prototype, streams = columns[0] + extra[0], [*columns[1], *extra[1]]
    body = b""
    for half in (0, 1):
        parts = [s[:len(s) // 3] if half == 0 else s[len(s) // 3:] for s in streams]
        packet = struct.pack(f"<H{len(parts)}H", len(parts), *map(len, parts)) + b"".join(parts)
        packet += bytes(-(len(packet) + 4) % 4)
        body += struct.pack("<BBH", 1, 0, len(packet) + 3) + packet
    section = struct.pack("<BxxxxxxxQQQ", 1, 32 + len(body), 48 + 32, 0) + body
    xml = ('<?xml version="1.0"?><e57Root type="Structure" xmlns="urn:e57"><data3D type="Vector">'
           f'<vectorChild type="Structure">{pose}<points type="CompressedVector" fileOffset="48" '
           f'recordCount="{len(POINTS)}"><prototype type="Structure">{prototype}</prototype>'
           '<codecs type="Vector"/></points></vectorChild></data3D></e57Root>').encode()
    logical = 48 + len(section)
    content = struct.pack("<8sIIQQQQ", b"ASTM-E57", 1, 0, 0, logical // 1020 * 1024
                          + logical % 1020, len(xml), 1024) + section + xml
    path.write_bytes(sealed(content))


def sealed(content):
    """Pages of E57 with their checksums."""
    pages = np.frombuffer(content + bytes(-len(content) % 1020), np.uint8).reshape(-1, 1020)
    return np.hstack([pages, checksums(pages).astype(">u4")[:, None].view(np.uint8)]).tobytes()


M1, M2 = np.array([0.1, 0.2, 0.3]), np.array([0.15, 0.22, 0.5])
COUNT = 20
"""Markers [m] and frames of a capture."""


def rows(first, scale, separator=",", more=()):
    """Rows of two markers that move in x by 1 mm a frame."""
    found = []
    for k in range(COUNT):
        values = np.r_[M1 + [1e-3 * k, 0, 0], M2 + [1e-3 * k, 0, 0]] * scale
        found.append(separator.join([*first(k), *(f"{value:.6f}" for value in values), *more]))
    return "\n".join(found) + "\n"


def motive(unit, scale, rigid=False):
    """Two markers; with ``rigid`` after a rigid body of a rotation, a position and an error."""
    kinds, names = ["Marker"] * 6, ["M1"] * 3 + ["M2"] * 3
    parts, axes = ["Position"] * 6, [*"XYZXYZ"]
    if rigid:
        kinds, names = ["Rigid Body"] * 8 + kinds, ["Branch"] * 8 + names
        parts = ["Rotation"] * 4 + ["Position"] * 3 + ["Mean Marker Error"] + parts
        axes = [*"XYZWXYZ", "", *axes]
    head = [f"Format Version,1.23,Export Frame Rate,100.0,Length Units,{unit}", ""]
    head += [",".join(["", word, *cells]) for word, cells in (
        ("Type", kinds), ("Name", names), ("ID", ["A1"] * len(names)), ("", parts))]
    head.append(",".join(["Frame", "Time (Seconds)", *axes]))

    def first(k):
        return [str(k), f"{k / 100:.6f}", *(["0.5"] * 8 if rigid else [])]
    return "\n".join(head) + "\n" + rows(first, scale)


VICON = ("Trajectories\n100\n,,Beam:M1,,,Beam:M2,,\nFrame,Sub Frame,X,Y,Z,X,Y,Z\n"
         ",,mm,mm,mm,mm,mm,mm\n" + rows(lambda k: [str(k + 1), "0"], 1e3))
CAPTURES = {
    "motive.csv": motive("Millimeters", 1e3), "motive_m.csv": motive("Meters", 1),
    "motive_rigid.csv": motive("Centimeters", 100, rigid=True), "vicon.csv": VICON,
    "vicon_devices.csv": "Devices\n1000\n,,Force,,\nFrame,Sub Frame,Fx,Fy,Fz\n,,N,N,N\n"
                         + "".join(f"{k},0,1,2,3\n" for k in range(90)) + "\n" + VICON,
    "qualisys.tsv": "NO_OF_FRAMES\t20\nFREQUENCY\t100\nMARKER_NAMES\tM1\tM2\n"
                    + rows(lambda k: [], 1e3, "\t"),
    "qualisys_header.tsv": "NO_OF_FRAMES\t20\nFREQUENCY\t100\nMARKER_NAMES\tM1\tM2\nFrame\tTime\t"
                           "M1 X\tM1 Y\tM1 Z\tM2 X\tM2 Y\tM2 Z\n"
                           + rows(lambda k: [str(k + 1), f"{k / 100:.5f}"], 1e3, "\t"),
    "opensim.trc": "PathFileType\t4\t(X/Y/Z)\ta.trc\nDataRate\tCameraRate\tNumFrames\tNumMarkers\t"
                   "Units\tOrigDataRate\n100.0\t100.0\t20\t2\tmm\t100.0\nFrame#\tTime\tM1\t\t\tM2"
                   "\t\t\n\t\tX1\tY1\tZ1\tX2\tY2\tZ2\n\n"
                   + rows(lambda k: [str(k + 1), f"{k / 100:.5f}"], 1e3, "\t"),
}


def _write_pcd(path, kind):
    header = ("# .PCD v0.7\nVERSION 0.7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\n"
              f"COUNT 1 1 1 1\nWIDTH 200\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 200\n"
              f"DATA {kind}\n")
    table = np.column_stack([CLOUD, np.arange(200)]).astype(np.float32)
    body = table.tobytes() if kind == "binary" else "\n".join(
        " ".join(map(str, row)) for row in table).encode()
    path.write_bytes(header.encode() + body)


def _write_compressed_pcd(path):
    from pypcd4 import Encoding, PointCloud

    PointCloud.from_xyz_points(CLOUD.astype(np.float32)).save(
        path, encoding=Encoding.BINARY_COMPRESSED)


def write_ascii_ply(path):
    rows = "\n".join(f"{x} {y} {z} 0 0 1 200 10 20" for x, y, z in CLOUD)
    names = "".join(f"property float {n}\n" for n in ("x", "y", "z", "nx", "ny", "nz"))
    names += "".join(f"property uchar {n}\n" for n in ("red", "green", "blue"))
    path.write_text(f"ply\nformat ascii 1.0\nelement vertex 200\n{names}end_header\n{rows}\n")


def _write_las(path, point_format=3):
    import laspy

    content = laspy.create(point_format=point_format)
    content.header.scales, content.header.offsets = [1e-5] * 3, [0, 0, 0]
    content.x, content.y, content.z = CLOUD.T
    content.intensity = np.arange(200)
    content.write(path)


def _write_faces(path):
    from plyfile import PlyData, PlyElement

    table = np.core.records.fromarrays(CLOUD.T.astype(np.float32), names="x,y,z")
    face = np.zeros(4, [("vertex_indices", "i4", (3,))])
    PlyData([PlyElement.describe(table, "vertex"), PlyElement.describe(face, "face")]).write(
        str(path))


CLOUDS = {
    "a.xyz": lambda p: np.savetxt(p, CLOUD),
    "a.csv": lambda p: np.savetxt(p, CLOUD, delimiter=",", header="x,y,z", comments=""),
    "semicolon.txt": lambda p: np.savetxt(p, CLOUD, delimiter=";"),
    "double.ply": lambda p: Cloud(CLOUD).write_ply(p),
    "ascii.ply": write_ascii_ply,
    "a.pcd": lambda p: _write_pcd(p, "ascii"),
    "b.pcd": lambda p: _write_pcd(p, "binary"),
    "c.pcd": _write_compressed_pcd,
    "a.las": _write_las,
    "a.laz": _write_las,
    "b.las": lambda p: _write_las(p, 6),
    "b.laz": lambda p: _write_las(p, 6),
    "faces.ply": _write_faces,
    "a.npy": lambda p: np.save(p, CLOUD),
    "a.npz": lambda p: np.savez(p, points=CLOUD, intensity=np.arange(200)),
    "a.obj": lambda p: p.write_text("".join(f"v {x} {y} {z}\n" for x, y, z in CLOUD)),
}
