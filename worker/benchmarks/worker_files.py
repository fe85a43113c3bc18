"""Files that others may have written, good ones of each kind, and their readers, for the fuzz."""

import importlib
import json
import shutil
import sys
import tempfile
import types
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.foreign_files import CAPTURES, CLOUDS, FLOATS, SCALED, e57, ptx, sealed
from benchmarks.worker_branch_files import Reader, template_file
from limber.core.errors import InputError
from limber.geometry.io.formats import Registry
from limber.geometry.io.skeletons import SKELETONS
from limber.geometry.io.surfaces import SURFACES
from limber.store import Branch

_PAGE = 1024


def _clouds(suffixes: str, _template: Path, folder: Path) -> list[Path]:
    """Clouds in each form that these suffixes have."""
    files = [folder / name for name in CLOUDS if Path(name).suffix in suffixes.split()]
    for path in files:
        CLOUDS[path.name](path)
    return files


def _meshes(suffix: str, _template: Path, folder: Path) -> list[Path]:
    import trimesh

    path = folder / f"ball{suffix}"
    trimesh.creation.icosphere(subdivisions=3, radius=0.1).export(path)
    return [path]


def _cloud(_template: Path, path: Path) -> Any:
    from limber.geometry.io.clouds import read_points

    cloud = read_points(path)
    return cloud.points


def _pixels(_template: Path, folder: Path) -> list[Path]:
    from PIL import Image

    path = folder / "depth.png"
    depth = np.full((24, 32), 900, np.uint16)
    depth[:, 15:18] = 700
    Image.fromarray(depth).save(path)
    return [path]


def _depth(_template: Path, path: Path) -> Any:
    from limber.geometry.io.depth_images import read_depth

    with tempfile.TemporaryDirectory() as folder:
        return read_depth(path, _camera_file(_template, Path(folder))[0]).points


def _mask(_template: Path, path: Path) -> Any:
    from limber.geometry.cloud.camera import read_mask

    return read_mask(path)


def _camera_file(_template: Path, folder: Path) -> list[Path]:
    path = folder / "camera.toml"
    path.write_text("width = 32\nheight = 24\nfx = 40.0\nfy = 40.0\ncx = 15.5\ncy = 11.5\n"
                    "depth_scale = 1000.0\npose = [0.0, -1.0, 0.3, -1.57, 0.0, 0.0]\n")
    return [path]


def _camera(_template: Path, path: Path) -> Any:
    from limber.geometry.cloud.camera import depth_to_cloud, read_camera

    camera = read_camera(path)
    if camera.width * camera.height > 10_000:
        return camera
    return camera, depth_to_cloud(camera, np.ones((camera.height, camera.width)))


def _intrinsics(_template: Path, folder: Path) -> list[Path]:
    path = folder / "camera_intrinsic.json"
    path.write_text(json.dumps({"width": 32, "height": 24, "depth_scale": 1000.0,
                                "intrinsic_matrix": [40.0, 0, 0, 0, 40.0, 0, 15.5, 11.5, 1]}))
    return [path]


def _rgbd(name: str, _template: Path, path: Path) -> Any:
    """An RGB-D folder with one of its lists changed."""
    from limber.recordings.image_folders import copy_rgbd
    from limber.recordings.settings import ImportSpec

    with tempfile.TemporaryDirectory() as place:
        source, target = Path(place, "in"), Path(place, "out")
        (source / "depth").mkdir(parents=True)
        target.mkdir()
        image = _pixels(_template, Path(place))[0]
        for stamp in ("1.0", "1.1", "1.2"):
            shutil.copyfile(image, source / "depth" / f"{stamp}.png")
        _rgbd_lists(_template, source)
        if name == "camera_intrinsic.json":
            (source / "calibration.txt").unlink()
        shutil.copyfile(path, source / name)
        copy_rgbd(source, target, ImportSpec())
        from limber.geometry.cloud.camera import read_camera

        return read_camera(target / "camera.toml")


def _rgbd_lists(_template: Path, folder: Path) -> list[Path]:
    stamps = ("1.0", "1.1", "1.2")
    (folder / "depth.txt").write_text("# list\n" + "".join(
        f"{stamp} depth/{stamp}.png\n" for stamp in stamps))
    (folder / "groundtruth.txt").write_text("# pose\n" + "".join(
        f"{stamp} 0.1 0.2 0.3 0 0 0 1\n" for stamp in stamps))
    (folder / "calibration.txt").write_text("40.0 40.0 15.5 11.5\n")
    return [folder / "depth.txt", folder / "groundtruth.txt", folder / "calibration.txt"]


def _rgbd_list(name: str, template: Path, folder: Path) -> list[Path]:
    return [path for path in _rgbd_lists(template, folder) if path.name == name]


def _c3d(_template: Path, folder: Path) -> list[Path]:
    import ezc3d

    made = ezc3d.c3d()
    made["parameters"]["POINT"]["RATE"]["value"] = [100.0]
    made["parameters"]["POINT"]["LABELS"]["value"] = ["a", "b", "c"]
    made["parameters"]["POINT"]["UNITS"]["value"] = ["mm"]
    made["data"]["points"] = np.random.default_rng(1).uniform(10, 500, (4, 3, 40))
    path = folder / "markers.c3d"
    made.write(str(path))
    return [path]


def _read_c3d(_template: Path, path: Path) -> Any:
    from limber.recordings.import_request import ImportRequest
    from limber.recordings.recording_formats import RECORDINGS

    return RECORDINGS.read(path, request=ImportRequest(path))


def _tables(_template: Path, folder: Path) -> list[Path]:
    times = np.linspace(0, 2, 50)
    markers, force = folder / "markers.csv", folder / "force.csv"
    np.savetxt(markers, np.column_stack([times, *(np.sin(times + k) for k in range(6))]), "%.6g",
               ",", header="t_s,a_x_m,a_y_m,a_z_m,b_x_m,b_y_m,b_z_m", comments="")
    np.savetxt(force, np.column_stack([0.01 * times, 2 * times]), "%.6g", ";",
               header="Displacement (mm);Force (N)", comments="")
    return [markers, force]


def _table(_template: Path, path: Path) -> Any:
    from limber.recordings.force_slope import read_force_displacement
    from limber.recordings.tables import marker_stream, read_table

    if "force" in path.name:
        return read_force_displacement(path, unit=None, force_unit=None)
    read_table(path)
    return marker_stream(path)[0]


def _nominal(_template: Path, folder: Path) -> list[Path]:
    path = folder / "nominal.csv"
    path.write_text("label,x_m,y_m,z_m\na,0,0,0.1\nb,0,0,0.2\nc,0.1,0,0.2\n")
    return [path]


def _read_nominal(_template: Path, path: Path) -> Any:
    from limber.recordings.import_request import read_nominal

    return read_nominal(path)


def _calipers(_template: Path, folder: Path) -> list[Path]:
    path = folder / "calipers.csv"
    path.write_text("along_m,diameter_mm\n0.05,12.1\n0.1,11.4\n0.2,9.0\n")
    return [path]


def _read_calipers(_template: Path, path: Path) -> Any:
    from limber.geometry.skeleton.qsm_tables import read_calipers

    return read_calipers(path)


def _decay(name: str, column: str, _template: Path, folder: Path) -> list[Path]:
    path, times = folder / name, np.arange(0, 4, 0.02)
    values = 3 + np.exp(-0.5 * times) * np.cos(15 * times)
    path.write_text(f"time_s,{column}\n" + "".join(
        f"{at:.3f},{value:.4f}\n" for at, value in zip(times, values, strict=True)))
    return [path]


def _ring(_template: Path, path: Path) -> Any:
    from limber.estimation.vibration.ringing import identify, read_record

    record = read_record(path)
    return identify(record.times, record.values)


def _wind(_template: Path, path: Path) -> Any:
    from limber.mechanics.loads.load_effects import WindRecord
    from limber.mechanics.loads.outdoor import Swaying, recorded

    wind = WindRecord.read(path)
    wind.even_wind((1.0, 0.0, 0.0))
    return recorded(Swaying(np.ones(1), np.full(1, 0.05), np.ones(1)), wind.times, wind.speeds)


def _edits(_template: Path, folder: Path) -> list[Path]:
    path = folder / "edits.json"
    path.write_text(json.dumps([{"do": "radius", "at": [0, 0, 0.2], "radius": 0.01},
                                {"do": "root", "at": [0, 0, 0]},
                                {"do": "confirm", "at": [0, 0, 0.3]}]))
    return [path]


def _read_edits(_template: Path, path: Path) -> Any:
    from limber.geometry.skeleton.edits import read_edits

    return read_edits(path)


def _jobs(_template: Path, folder: Path) -> list[Path]:
    path = folder / "jobs.toml"
    path.write_text(
        'out = "results"\ntime_limit = "1 h"\nmemory_limit = "4 GB"\nworkers = 2\n[[job]]\n'
        'scans = ["*.xyz"]\n[[job.stage]]\nrun = "reconstruct"\nunit = "mm"\n'
        '[[job.stage]]\nrun = "energy"\nsamples = 60\ndeflection = 0.4\n[job.sweep]\n'
        '"energy.seed" = [1, 2]\n')
    return [path]


def _read_jobs(_template: Path, path: Path) -> Any:
    from limber.batch.job_file import read_jobs

    (path.parent / "a.xyz").write_text("0 0 0\n")
    read_jobs(path)


def _cell(_template: Path, folder: Path) -> list[Path]:
    from benchmarks.robot_faults import cell_for
    from limber.cell.cell_file import write_cell

    path = folder / "cell.toml"
    write_cell(path, cell_for("127.0.0.71"))
    return [path]


def _read_cell(_template: Path, path: Path) -> Any:
    from limber.cell.cell_file import read_cell

    return read_cell(path)


def _commands(_template: Path, folder: Path) -> list[Path]:
    path = folder / "commands.jsonl"
    path.write_text("\n".join(json.dumps(one) for one in (
        {"command": "hello", "protocol": 2, "id": 1},
        {"command": "grasp", "vertex": 4, "mode": "point", "radius_m": 0.01},
        {"command": "move", "pose": [0.1, 0, 0.4, 0, 0, 0], "grasp": 1},
        {"command": "young", "young_pa": [1e8, 1e8]},
        {"command": "loads", "loads": [{"point": [0, 0, 0.3], "force_n": [0, 0, -1]}]},
        {"command": "outdoors", "wind_m_s": [4, 0, 0], "snow_kg_m2": 2, "cuts": [[0, 0, 0.3]],
         "fruit": [{"point": [0, 0, 0.2], "mass_kg": 0.1}]},
        {"command": "effects", "limit_load": True, "gust_record": {
            "time_s": [0.0, 0.5, 1.0], "speed_m_s": [3.0, 5.0, 4.0]}})) + "\n")
    return [path]


def _read_commands(_template: Path, path: Path) -> Any:
    """A session's input lines: each is a command, or is answered with an error."""
    from limber.session.protocol import Lines, NotUnderstood, parse_command

    understood = []
    for line in Lines().feed(path.read_bytes()):
        if line is None:
            continue
        try:
            understood.append(parse_command(line))
        except NotUnderstood:
            continue
    return understood


def _cylinder_models(suffix: str, template: Path, folder: Path) -> list[Path]:
    from limber.stages.results.export import Export

    files = [folder / f"tree{suffix}"]
    Export(branch_folder=template, output=files[0]).run()
    return files


def _read(registry: Registry, _template: Path, path: Path) -> Any:
    return registry.read(path)


@cache
def addon_module(name: str) -> Any:
    """A module of the add-on that needs no Blender."""
    # Its package file does.
    package = sys.modules.setdefault("addon_files", types.ModuleType("addon_files"))
    root = Path(__file__).parents[2]
    package.__path__ = [str(root / "addon"), str(root / "worker" / "limber" / "core" / "files")]
    return importlib.import_module(f"addon_files.{name}")


def _addon_read(module: str, function: str, _template: Path, path: Path) -> Any:
    """Readers of the add-on; they refuse with ValueError."""
    try:
        return getattr(addon_module(module), function)(path)
    except ValueError as error:
        if type(error) is not ValueError and not type(error).__name__.endswith("DataError"):
            raise
        raise InputError(str(error)) from error


def _scene_file(template: Path, folder: Path) -> list[Path]:
    from limber.results.scene.animation import scene_data

    path = folder / "scene.npz"
    scene_data(Branch.open(template)).write(path)
    return [path]


def _matlab_73(template: Path, folder: Path) -> list[Path]:
    """The cylinder model as Matlab saves it in version 7.3: HDF5 behind its own header."""
    import h5py
    from scipy.io import loadmat

    held = loadmat(_cylinder_models(".mat", template, folder)[0])["QSM"]["cylinder"][0, 0]
    path = folder / "tree73.mat"
    with h5py.File(path, "w", userblock_size=512) as file:
        for name in held.dtype.names:
            file[f"QSM/cylinder/{name}"] = held[name][0, 0].T
    with open(path, "r+b") as stream:
        stream.write(b"MATLAB 7.3 MAT-file".ljust(512))
    return [path]


def _rtde(_template: Path, folder: Path) -> list[Path]:
    """A robot's log as ur-rtde records it."""
    path, times = folder / "rtde.csv", np.linspace(0, 1, 40)
    rows = np.column_stack([times, 0.05 * times, *np.tile([[0.0], [0.5], [0.1], [0.2], [0.3]], 40),
                            2.5 * times, *np.zeros((5, 40))])
    np.savetxt(path, rows, "%.9g", ",", comments="", header=",".join([
        "timestamp", *(f"actual_TCP_pose_{k}" for k in range(6)),
        *(f"actual_TCP_force_{k}" for k in range(6))]))
    return [path]


def _log(_template: Path, path: Path) -> Any:
    """A robot's log, up to the pull made from it."""
    from limber.recordings.tables import is_robot_table, read_table, robot_stream, split_title

    return is_robot_table([split_title(title) for title in read_table(path).titles]), robot_stream(
        path)


# --- laser scanners and motion capture ----------------------------------------------------------


def _ptx(_template: Path, folder: Path) -> list[Path]:
    ptx(folder / "scan.ptx", colour=True, silent=1)
    return [folder / "scan.ptx"]


def _e57(_template: Path, folder: Path) -> list[Path]:
    """One scan of plain numbers and one of scaled ones, each in its own file."""
    files = [folder / "plain.e57", folder / "scaled.e57"]
    for path, columns in zip(files, (FLOATS, SCALED), strict=True):
        e57(path, columns)
    return files


def _read_e57(_template: Path, path: Path) -> Any:
    """Read a file with its checksums corrected, so that a fuzz's changes reach the reader."""
    raw = path.read_bytes()
    pages = [raw[k:k + _PAGE - 4] for k in range(0, len(raw), _PAGE)]
    path.write_bytes(sealed(b"".join(pages)))
    return _cloud(_template, path)


def _capture(name: str, _template: Path, folder: Path) -> list[Path]:
    (folder / name).write_text(CAPTURES[name])
    return [folder / name]


def _markers(_template: Path, path: Path) -> Any:
    from limber.recordings.tables import marker_stream

    return marker_stream(path)[0]


FILE_READERS: dict[str, Reader] = {
    "PLY": Reader("binary", partial(_clouds, ".ply"), _cloud),
    "PCD": Reader("binary", partial(_clouds, ".pcd"), _cloud),
    "XYZ": Reader("text", partial(_clouds, ".xyz .csv"), _cloud),
    "LAS": Reader("binary", partial(_clouds, ".las"), _cloud),
    "LAZ": Reader("binary", partial(_clouds, ".laz"), _cloud),
    "OBJ": Reader("text", partial(_meshes, ".obj"), _cloud),
    "STL": Reader("binary", partial(_meshes, ".stl"), _cloud),
    "OFF": Reader("text", partial(_meshes, ".off"), _cloud),
    "NPZ": Reader("npz", partial(_clouds, ".npz"), _cloud),
    "NPY": Reader("binary", partial(_clouds, ".npy"), _cloud),
    "PNG depth": Reader("binary", _pixels, _depth), "PNG mask": Reader("binary", _pixels, _mask),
    "camera TOML": Reader("text", _camera_file, _camera),
    "intrinsics JSON": Reader("json", _intrinsics, partial(_rgbd, "camera_intrinsic.json")),
    **{f"RGB-D {name}": Reader("text", partial(_rgbd_list, name), partial(_rgbd, name))
       for name in ("depth.txt", "groundtruth.txt", "calibration.txt")},
    "C3D": Reader("binary", _c3d, _read_c3d, True),
    "tables CSV": Reader("text", _tables, _table, True),
    "nominal CSV": Reader("text", _nominal, _read_nominal),
    "calipers CSV": Reader("text", _calipers, _read_calipers),
    "MAT v7.3": Reader("binary", _matlab_73, partial(_read, SKELETONS)),
    "RTDE CSV": Reader("text", _rtde, _log, True),
    "MAT": Reader("binary", partial(_cylinder_models, ".mat"), partial(_read, SKELETONS)),
    "rTwig CSV": Reader("text", partial(_cylinder_models, ".csv"), partial(_read, SKELETONS)),
    "ring CSV": Reader("text", partial(_decay, "ring.csv", "a_m_s2"), _ring),
    "wind CSV": Reader("text", partial(_decay, "wind.csv", "speed_m_s"), _wind),
    "MTG": Reader("text", partial(_cylinder_models, ".mtg"), partial(_read, SKELETONS)),
    "add-on clouds": Reader("binary", partial(_clouds, ".ply .xyz .csv"),
                            partial(_addon_read, "scan.clouds", "read_points")),
    "add-on scene data": Reader("npz", _scene_file, partial(
        _addon_read, "show.scene_data", "read_scene_data"), True),
    "SWC": Reader("text", partial(template_file, "skeleton.swc"), partial(_read, SKELETONS)),
    "surface PLY": Reader("binary", partial(template_file, "surface.ply"),
                          partial(_read, SURFACES)),
    "edits JSON": Reader("json", _edits, _read_edits),
    "job TOML": Reader("text", _jobs, _read_jobs),
    "cell TOML": Reader("text", _cell, _read_cell),
    "session commands": Reader("text", _commands, _read_commands),
    "PTX": Reader("text", _ptx, _cloud), "E57": Reader("binary", _e57, _read_e57),
    "Motive CSV": Reader("text", partial(_capture, "motive.csv"), _markers, True),
    "Vicon CSV": Reader("text", partial(_capture, "vicon.csv"), _markers, True),
    "Qualisys TSV": Reader("text", partial(_capture, "qualisys.tsv"), _markers, True)}
"""By name."""
