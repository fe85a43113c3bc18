"""Files as in public reports and from other programs: read with the right value, or not.

Those of ``shared/data/reports`` are read in their folder beside the checkout; two more of each kind
are drawn here. In addition, one good file is read repeatedly on a busy machine.
"""

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.table import Asked, Row, Setting
from limber.estimation.vibration.ringing import identify, read_record
from limber.geometry.io.clouds import read_cloud
from limber.geometry.io.surfaces import usable_surface
from limber.geometry.surface.surface import Surface
from limber.recordings.bags.bag_pull import pull_of_bag
from limber.recordings.bags.bag_reader import Bag, Topic, read_bag
from limber.recordings.settings import ImportSettings
from limber.recordings.tables import marker_stream
from limber.robot.virtual.arm_motions import Servo

REPORT_ROWS = (
    Asked("files after public reports, and two more of each kind: right value", "all"),
    Asked("one LAZ file at nice 19 beside four busy processes (200 reads asked): refused", "0"))
_REPORTS = Path(__file__).parents[3] / "shared" / "data" / "reports"
_SIZE = np.array([0.243, 0.114, 0.600])
_READS = 200

Case = tuple[str, Callable[[], bool]]
"""A name, and whether the value is right."""


def reported(setting: Setting) -> list[Row]:
    """The two rows."""
    rng, folder = np.random.default_rng(setting.seed), setting.kept / "reports"
    folder.mkdir(parents=True, exist_ok=True)
    wrong, count = [], 0
    for name, is_right in (*_found(), *_clouds(rng, folder), *_motions(rng, folder),
                           *_rings(rng, folder), *_others(rng, folder)):
        count += 1
        try:
            if not is_right():
                wrong.append(f"{name}: another value")
        except Exception as error:  # whatever a reader raises, the file was not read
            wrong.append(f"{name}: {type(error).__name__}: {error}")
    for line in wrong:
        print(line)
    first = Row(*REPORT_ROWS[0], f"{count - len(wrong)} of {count}", not wrong, count)
    return [first, _busy(setting, folder)]


def _found() -> Iterator[Case]:
    """The reported files themselves."""
    clouds = ("01-csv-unnamed-index/r_writecsv.csv", "02-column-names/csv_space_col.csv",
              "02-column-names/de_semicolon.csv", "03-id-column-in-blender/cols_zxy.csv",
              "03-id-column-in-blender/id_first.csv", "04-cloudcompare-ascii/cc_header.asc",
              "05-ply-nonascii-comment/ply_umlaut.ply", "06-float-colours/ply_floatcolor.ply",
              "07-colmap-points3D/colmap_points3D.txt", "23-pcd-old/pcd_v5_nocount.pcd",
              "24-leica-pts/leica_two_scans.pts")
    cases: list[tuple[str, Callable[[Path], bool]]] = [
        *((name, partial(_is_sized, 1.0)) for name in clouds),
        ("08-unit-in-header/unit_x_mm_30mm.csv", partial(_is_sized, 0.05)),
        ("12-arduino-micros/arduino_ring.csv", partial(_rings_at, 21.64, 0.004)),
        ("13-mcap-zero-stamps/zero5.mcap", _is_short_pull),
        ("15-blender-cylinder-open-edges/blender_bar.obj", partial(_encloses, 1.6e-4)),
        ("17-motive-csv/motive.csv", partial(_has_markers, [[0.1, 0.2, 0.3], [0.15, 0.22, 0.5]])),
        ("21-logger-ring/logger_ring.csv", partial(_rings_at, 21.64, 0.004)),
        ("22-repeated-plucks/four_plucks.csv", partial(_rings_at, 21.7, 0.1))]
    for name, is_right in cases:
        if (_REPORTS / name).exists():
            yield name, partial(is_right, _REPORTS / name)


def _is_sized(scale: float, path: Path) -> bool:
    return np.allclose(np.ptp(read_cloud(path).points, axis=0), scale * _SIZE, rtol=2e-3)


def _rings_at(frequency: float, ratio: float, path: Path) -> bool:
    record = read_record(path)
    found = identify(record.times, record.values)
    return bool(abs(found.frequencies[0] / frequency - 1) < 2e-3
                and abs(found.damping[0] / ratio - 1) < 0.1)


def _is_short_pull(path: Path) -> bool:
    pull = pull_of_bag(read_bag(path), path.parent, ImportSettings())
    return bool(abs(pull.robot.times[-1] - 5.2) < 0.1)


def _encloses(volume: float, path: Path) -> bool:
    surface, _ = usable_surface(Surface.read(path), path)
    return bool(abs(surface.volume / volume - 1) < 1e-3)


def _has_markers(first: list[list[float]], path: Path) -> bool:
    stream, labels = marker_stream(path)
    return len(labels) == len(first) and np.allclose(stream.values[0], np.ravel(first)) and (
        np.allclose(np.diff(stream.times), 0.01))


_HEADERS = (
    # name, titles, separator, order of the axes, columns before and after, metres per unit
    ("01 pandas.csv", ",x,y,z", ",", "xyz", ("{k}",), (), 1.0),
    ("01 words.csv", '"","x","y","z"', ",", "xyz", ("p{k}",), (), 1.0),
    ("02 blanks.csv", "X;Y;Z;Return Number [1]", ";", "xyz", (), ("1",), 1.0),
    ("02 survey.csv", "Rechtswert;Hochwert;H\u00f6he;G\u00fcte", ";", "xyz", (), ("0,5",), 1.0),
    ("03 point.csv", "Point,Z,Y,X", ",", "zyx", ("{k}",), (), 1.0),
    ("03 index.csv", "index y z x", " ", "yzx", ("{k}",), (), 1.0),
    ("04 plain.asc", "//X Y Z", " ", "xyz", (), (), 1.0),
    ("04 normals.asc", "//X Y Z R G B Nx Ny Nz", " ", "xyz", (), tuple("987001"), 1.0),
    ("08 brackets.csv", "X (mm),Y (mm),Z (mm)", ",", "xyz", (), (), 1e-3),
    ("08 middle.csv", "Position [cm] X;Position [cm] Y;Position [cm] Z", ";", "xyz", (), (), 1e-2))


def _clouds(rng: np.random.Generator, folder: Path) -> Iterator[Case]:
    points = rng.uniform(-9, 9, (40, 3)).round(4)
    for name, titles, mark, order, before, behind, unit in _HEADERS:
        path = folder / name.replace(" ", "-")
        rows = [mark.join([*(word.format(k=k) for word in before),
                           *(f"{point['xyz'.index(axis)]:.4f}" for axis in order), *behind])
                for k, point in enumerate(points)]
        body = "\n".join(rows)
        path.write_text(f"{titles}\n{body.replace('.', ',') if mark == ';' else body}\n",
                        encoding="utf-8")
        yield name, partial(_is_cloud, path, points * unit)
    body = "\n".join(" ".join(f"{v:.4f}" for v in point) for point in points)
    for name, version in (("23 v6.pcd", "0.6"), ("23 v7.pcd", ".7")):
        path = folder / name.replace(" ", "-")
        path.write_text(f"VERSION {version} \nFIELDS x y z \nSIZE 4 4 4 \nTYPE F F F \nWIDTH 40 \n"
                        f"HEIGHT 1 \nDATA ascii \n{body}\n")
        yield name, partial(_is_cloud, path, points)
    for name, coding in (("05 latin.ply", "latin-1"), ("05 utf.ply", "utf-8")):
        path = folder / name.replace(" ", "-")
        path.write_bytes(("ply\nformat ascii 1.0\ncomment f\u00fcr die Pr\u00fcfung\n"
                          "element vertex 40\nproperty float x\nproperty float y\n"
                          "property float z\nend_header\n"
                          + body + "\n").encode(coding))
        yield name, partial(_is_cloud, path, points)
    for name, colour in (("06 fractions.ply", "0.25 0.5 0.75"), ("06 words.ply", "64 128 191")):
        path = folder / name.replace(" ", "-")
        kind = "float" if "." in colour else "ushort"
        rows_text = "\n".join(f"{line} {colour}" for line in body.splitlines())
        path.write_text("ply\nformat ascii 1.0\nelement vertex 40\n" + "".join(
            f"property float {axis}\n" for axis in "xyz") + "".join(
            f"property {kind} {part}\n" for part in ("red", "green", "blue"))
            + f"end_header\n{rows_text}\n")
        yield name, partial(_has_colour, path, [64, 128, 191])
    for name, tracks in (("07 short.txt", 1), ("07 long.txt", 5)):
        path = folder / name.replace(" ", "-")
        path.write_text("# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[]\n" + "".join(
            f"{7 * k} {line} 9 8 7 0.3 {'1 2 ' * (k % tracks)}\n"
            for k, line in enumerate(body.splitlines())))
        yield name, partial(_is_cloud, path, points)
    for name, more in (("24 grey.pts", "-900"), ("24 colour.pts", "17 9 8 7")):
        path = folder / name.replace(" ", "-")
        lines = [f"{line} {more}\n" for line in body.splitlines()]
        path.write_text(f"15\n{''.join(lines[:15])}25\n{''.join(lines[15:])}")
        yield name, partial(_is_cloud, path, points)


def _is_cloud(path: Path, points: np.ndarray) -> bool:
    return np.allclose(read_cloud(path).points, points, rtol=1e-6)


def _has_colour(path: Path, colour: list[int]) -> bool:
    return read_cloud(path).attributes["color"][0].tolist() == colour


def _motions(rng: np.random.Generator, folder: Path) -> Iterator[Case]:
    first = rng.uniform(0.1, 1.0, (3, 3)).round(4)
    rows = [",".join(f"{1e3 * value:.3f}" for value in np.ravel(first + [1e-3 * k, 0, 0]))
            for k in range(30)]
    named = ",".join(f"Twig:P{k},," for k in range(3))
    (folder / "17-vicon.csv").write_text(
        f"Trajectories\n100\n,,{named}\nFrame,Sub Frame{',X,Y,Z' * 3}\n,{',mm' * 9}\n"
        + "".join(f"{k + 1},0,{row}\n" for k, row in enumerate(rows)))
    (folder / "17-qualisys.tsv").write_text(
        "NO_OF_FRAMES\t30\nFREQUENCY\t100\nMARKER_NAMES\tP0\tP1\tP2\n"
        + "".join(row.replace(",", "\t") + "\n" for row in rows))
    for name in ("17-vicon.csv", "17-qualisys.tsv"):
        yield name, partial(_has_markers, first.tolist(), folder / name)
    for bad in ([0, 1], [0, 5, 6]):
        yield f"13 zeros at {bad}", partial(_is_stamped, bad)
    for slider in (0.25, 0.75):
        yield f"20 slider at {slider}", partial(_is_slowed, slider, float(rng.uniform(0.05, 0.3)))


def _is_stamped(bad: list[int]) -> bool:
    times = 1.7e9 + 0.1 * np.arange(30)
    times[bad] = 0.0
    pose = np.tile([0.0, 0, 0, 0, 0, 0, 1.0], (30, 1))
    topics = {kind: (Topic(f"/{kind}", "branch", times, times, values),)
              for kind, values in (("pose", pose), ("wrench", np.zeros((30, 6))))}
    pull = pull_of_bag(Bag(Path("a.mcap"), topics, (), 0), Path(), ImportSettings())
    return len(pull.robot.times) == 30 - len(bad) and pull.robot.times[-1] < 3.0


def _is_slowed(slider: float, speed: float) -> bool:
    servo, joints, speeds = Servo(), np.zeros(6), np.zeros(6)
    for k in range(1000):
        servo.target = np.array([speed * 0.002 * (k + 1), 0, 0, 0, 0, 0])
        joints, speeds = servo.step(joints, speeds, 0.002, slider)
    return bool(abs(joints[0] - slider * speed * (2.0 - servo.lookahead)) < 0.02 * speed)


def _rings(rng: np.random.Generator, folder: Path) -> Iterator[Case]:
    """Clocks, loggers' columns and several plucks, each with drawn frequency and damping."""
    for name, title, stamp, plucked, limit, more in (
            ("12 millis.csv", "millis", "{ms:.0f}", 1, None, False),
            ("12 nanos.csv", "time", "{ns:.0f}", 1, None, False),
            ("21 dates.csv", "TIMESTAMP", "2024-05-01 10:11:{s:09.6f}", 1, None, True),
            ("21 seconds.csv", "Time (s)", "{s:.4f}", 1, None, True),
            ("22 two.csv", "t_s", "{s:.4f}", 2, None, False),
            ("22 cut.csv", "t_us", "{us:.0f}", 3, 0.5, False)):
        frequency, ratio = float(rng.uniform(2, 20)), float(rng.uniform(0.01, 0.06))
        times, values = np.arange(0, 16, 0.004), np.zeros(4000)
        for start in np.linspace(1, 11, plucked):
            since, omega = times - start, 2 * np.pi * frequency
            values = np.where(since >= 0, np.exp(-ratio * omega * since) * np.cos(
                omega * np.sqrt(1 - ratio**2) * since), values)
        values = values + 0.005 * rng.standard_normal(len(values))
        values = values if limit is None else np.clip(values, -limit, limit)
        lines = [f"{title},a" + (",count,temp,b" if more else "")]
        for k, (time_s, value) in enumerate(zip(times, values, strict=True)):
            beside = f",{k},{20 + 0.1 * np.sin(0.3 * time_s):.4f},{rng.normal():.4f}"
            at = stamp.format(s=time_s, ms=1e3 * time_s, us=1e6 * time_s, ns=1e9 * time_s + 1.7e18)
            lines.append(f"{at},{value:.6f}" + (beside if more else ""))
        path = folder / name.replace(" ", "-")
        path.write_text("\n".join(lines) + "\n")
        yield name, partial(_rings_at, frequency, ratio, path)


def _others(rng: np.random.Generator, folder: Path) -> Iterator[Case]:
    """Closed bodies whose vertices are split."""
    import trimesh

    for name, shape in (("15 bar.obj", trimesh.creation.cylinder(0.01, float(rng.uniform(.2, .9)),
                                                                sections=24)),
                        ("15 ball.obj", trimesh.creation.icosphere(2, float(rng.uniform(.1, .9))))):
        path = folder / name.replace(" ", "-")
        corners = shape.vertices[shape.faces.ravel()]
        path.write_text("".join(f"v {x:.6f} {y:.6f} {z:.6f}\n" for x, y, z in corners) + "".join(
            f"vn {x:.4f} {y:.4f} {z:.4f}\n" for x, y, z in shape.face_normals) + "".join(
            "f " + " ".join(f"{3 * k + c + 1}//{k + 1}" for c in range(3)) + "\n"
            for k in range(len(shape.faces))))
        yield name, partial(_encloses, float(shape.volume), path)


def _busy(setting: Setting, folder: Path) -> Row:
    """Read one LAZ file with the lowest processor priority, as often as the time allows."""
    import laspy

    path = folder / "busy.laz"
    content = laspy.create(point_format=3)
    content.header.scales = [1e-4] * 3
    content.x, content.y, content.z = np.random.default_rng(0).uniform(0, 1, (3, 5000))
    content.write(path)
    nice = ["nice", "-n", "19"] if os.name == "posix" else []
    program = ("import sys, pathlib; from limber.geometry.io.clouds import read_points; "
               "print(len(read_points(pathlib.Path(sys.argv[1]))))")
    others = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(4)]
    refused, longest = 0, 0.0
    count = 0
    try:
        for _ in setting.budget.items(range(3 if setting.quick else _READS)):
            began = time.perf_counter()
            done = subprocess.run([*nice, sys.executable, "-c", program, str(path)],
                                  capture_output=True, text=True, check=False,
                                  env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)})
            longest = max(longest, time.perf_counter() - began)
            count += 1
            if done.returncode or done.stdout.strip() != "5000":
                refused += 1
                print(done.stderr.strip().splitlines()[-1:])
    finally:
        for other in others:
            other.kill()
            other.wait()
    return Row(*REPORT_ROWS[1], f"{refused} of {count} reads (the longest took {longest:.0f} s)",
               refused == 0 if count >= _READS or refused else None, count)
