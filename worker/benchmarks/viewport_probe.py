"""Probe of the viewport's table inside Blender: this file runs in its Python, without limber.

    blender -b --factory-startup --python viewport_probe.py -- SETTINGS.json
    python viewport_probe.py -- SETTINGS.json            (with the bpy package)

Prints one JSON line per measure. Times are of the calls: without a window nothing is drawn.
"""

import importlib
import importlib.util
import json
import os
import sys
import time
import traceback
from pathlib import Path

import bpy  # noqa: TID253 (a program of its own, for Blender)
import numpy as np

_UNDO_ACTIONS = ("open", "colour", "cursor", "node", "radius", "discard", "import", "setting")


def load_addon(folder: Path) -> None:
    """Import the add-on's folder as a package called ``limber_addon``."""
    spec = importlib.util.spec_from_file_location(
        "limber_addon", folder / "__init__.py", submodule_search_locations=[str(folder)])
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)


def part(name: str):
    return importlib.import_module(f"limber_addon.{name}")


def say(measure: str, **numbers) -> None:
    print("\n" + json.dumps({"measure": measure, **numbers}), flush=True)


def spread(seconds: list[float]) -> dict[str, float]:
    """Median and 95 % of times, in ms."""
    return {"median_ms": 1e3 * float(np.median(seconds)),
            "high_ms": 1e3 * float(np.quantile(seconds, 0.95))}


def registering(folder: Path) -> None:
    """The first time imports the add-on's own modules too."""
    started = time.perf_counter()
    load_addon(folder)
    addon = sys.modules["limber_addon"]
    addon.register()
    first = time.perf_counter() - started
    again = []
    for _ in range(5):
        addon.unregister()
        started = time.perf_counter()
        addon.register()
        again.append(time.perf_counter() - started)
    say("register", first_ms=1e3 * first, again_ms=1e3 * min(again))


def frame_write(count: int, repeats: int) -> None:
    """Positions of a mesh written as the session's frames are."""
    meshes = part("bridge.meshes")
    mesh = meshes.new_mesh("frames", np.random.default_rng(0).random((count, 3)))
    bpy.context.scene.collection.objects.link(bpy.data.objects.new("frames", mesh))
    frames = np.random.default_rng(1).random((4, count, 3)).astype(np.float32)
    written = []
    for number in range(repeats):
        started = time.perf_counter()
        meshes.set_positions(mesh, frames[number % 4])
        written.append(time.perf_counter() - started)
        bpy.context.view_layer.update()
    say("frame write", frames=repeats, **spread(written))


def import_points(path: Path) -> None:
    """A scan as a user's import has it: read by a thread, then shown at once."""
    longest, started = 0.0, time.perf_counter()
    reading, last = part("scan.scans").reading(path), started
    while not reading.done():
        time.sleep(0.005)
        longest, last = max(longest, time.perf_counter() - last), time.perf_counter()
    scan = reading.result()
    mesh = part("bridge.meshes").new_mesh("cloud", scan.points)
    cloud = part("branch.branches").add_object(bpy.context.scene.collection, "cloud", mesh)
    bpy.context.view_layer.update()
    now = time.perf_counter()
    say("import", seconds=now - started, reading_ms=1e3 * longest, shown_ms=1e3 * (now - last),
        points=len(cloud.data.vertices))
    bpy.data.objects.remove(cloud)


def grab_loop(branch: Path, count: int) -> None:
    """Poses streamed to a session at 60 Hz, and Blender's handling of each answer."""
    sessions, meshes = part("bend.session"), part("bridge.meshes")
    branches = part("branch.branches")
    bpy.ops.limber.open_result(directory=str(branch))
    surface = branches.find_surface(bpy.context.scene)
    command = [*part("preferences").worker_command(), "session", "--no-grasp", str(branch)]
    held = sessions.Session(command, len(surface.data.vertices))
    try:
        _until(lambda: held.poll() is not None and (held.hello or held.error), 240)
        if held.error:
            raise RuntimeError(held.error)
        place = tuple(surface[branches.GRASP_KEY][:3])
        asked = held.grasp(place, 0.01)
        reply = _until(lambda: next((t for t in held.poll() if t.get("id") == asked), None), 30)
        number, start = reply["grasp"], np.array(reply["pose"][:3])
        # The reduced model answers from here on.
        learnt = _until(lambda: _who(held, number, start) == "reduced", 400, fail=False)
        held_back, own, waits = _streamed(held, surface, meshes, number, start, count)
        say("grab", poses=count, who="reduced" if learnt else "full", **spread(held_back),
            **{f"own_{name}": value for name, value in spread(own).items()},
            **{f"drawn_{name}": value for name, value in spread(waits).items()})
        before = _memory_mb()
        for step in range(count):
            held.release()
            asked = held.grasp(place, 0.01)
            reply = _until(lambda asked=asked: next(
                (t for t in held.poll() if t.get("id") == asked), None), 30)
            frame = held.frame()
            meshes.set_positions(surface.data, frame.positions)
            if step == count // 5:
                before = _memory_mb()
        say("grab memory", grabs=count, grown_mb=_memory_mb() - before)
    finally:
        held.close()


def _who(held, number: int, start: np.ndarray) -> str:
    time.sleep(0.2)
    held.poll()
    held.move(number, tuple(start + [0.002, 0.0, 0.0]))
    frame = held.frame()
    return frame.who if frame else ""


def _streamed(held, surface, meshes, number, start, count):
    """Time of a loop on Blender's side, its processor's fraction of it, and from a pose to the mesh
    that shows it, each [s].
    """
    ours, own, waits, sent = [], [], [], {}
    shown = held.frame().sequence
    for step in range(count):
        turn = 2 * np.pi * step / 200
        began, worked = time.perf_counter(), time.thread_time()
        held.poll()
        wanted = held.move(number, tuple(start + 0.01 * np.array([np.sin(turn), 0.0, 0.0])))
        sent[wanted] = began
        frame = held.frame(shown)
        if frame is not None:
            shown = frame.sequence
            meshes.set_positions(surface.data, frame.positions)
        ours.append(time.perf_counter() - began)
        own.append(time.thread_time() - worked)
        while time.perf_counter() - began < 1 / 60:
            newer = held.frame(shown)
            if newer is None:
                time.sleep(0.0005)
                continue
            shown = newer.sequence
            meshes.set_positions(surface.data, newer.positions)
            bpy.context.view_layer.update()
            if newer.answers in sent:
                waits.append(time.perf_counter() - sent[newer.answers])
    return ours, own, waits


def job_memory(count: int) -> None:
    """Jobs that print a little and end, one after the other."""
    jobs = part("jobs.jobs")
    program = "import json; print(json.dumps({'progress': 0.5})); print(json.dumps({'status': 1}))"
    before = _memory_mb()
    for number in range(count):
        jobs.start("probe", [sys.executable if not bpy.app.binary_path else "python3", "-c",
                             program]).wait()
        if number == count // 5:
            before = _memory_mb()
    jobs.forget()
    threads = len(sys._current_frames())
    say("job memory", jobs=count, grown_mb=_memory_mb() - before, threads=threads,
        files=len(os.listdir("/proc/self/fd")) if Path("/proc/self/fd").is_dir() else None)


def undo_sequences(branch: Path, cloud: Path, count: int, seed: int, seconds: float) -> None:
    """Random actions with undo and redo between them: each state is restored exactly."""
    wrong, steps, done, end = [], 0, 0, time.monotonic() + seconds
    for sequence in range(count):
        if done and time.monotonic() > end:
            break
        done += 1
        rng = np.random.default_rng([seed, sequence])
        bpy.ops.wm.read_factory_settings(use_empty=True)
        bpy.context.scene.limber.branch_folder = str(branch)
        bpy.ops.ed.undo_push(message="start")
        states, at = [_state()], 0
        for _ in range(rng.integers(4, 9)):
            steps += 1
            choice = rng.random()
            if choice < 0.25 and at > 0:
                bpy.ops.ed.undo()
                at -= 1
            elif choice < 0.45 and at < len(states) - 1:
                bpy.ops.ed.redo()
                at += 1
            else:
                name = str(rng.choice(_UNDO_ACTIONS))
                _act(name, branch, cloud, rng)
                bpy.ops.ed.undo_push(message=name)
                states[at + 1:] = [_state()]
                at += 1
            if _state() != states[at]:
                wrong.append({"sequence": sequence, "step": steps})
                break
    say("undo", sequences=done, steps=steps, wrong=wrong[:5], wrong_count=len(wrong))


def _act(name: str, branch: Path, cloud: Path, rng: np.random.Generator) -> None:
    limber, branches = bpy.ops.limber, part("branch.branches")
    skeleton = branches.find_skeleton(bpy.context.scene)
    surface = branches.find_surface(bpy.context.scene)
    if name == "open" and surface is None:
        # A file here replaces the worker's answer to each request.
        part("show.scene").show_branch(bpy.context.scene, part("show.scene_data").read_scene_data(
            branch.with_suffix(".npz")))
    elif name == "colour" and surface is not None:
        scalars = list(json.loads(surface[branches.INFO_KEY])["scalars"])
        limber.color_by(scalar=str(rng.choice(scalars)))
    elif name == "cursor":
        bpy.context.scene.cursor.location = rng.random(3)
        limber.from_cursor(stage="plan", field="goal")
    elif name == "node" and skeleton is not None:
        nodes = part("bridge.skeletons").nodes_of(skeleton)
        limber.edit_node(action="DELETE", node=int(rng.choice(nodes.number[1:])))
    elif name == "radius" and skeleton is not None:
        limber.edit_node(action="RADIUS", node=0, radius=float(rng.uniform(0.004, 0.01)))
    elif name == "discard" and skeleton is not None:
        limber.discard_skeleton()
    elif name == "import":
        limber.import_cloud(filepath=str(cloud))
    elif name == "setting":
        bpy.context.scene.limber.estimate.pith_radius = float(rng.uniform(0.001, 0.02))


def _state() -> str:
    """Objects, colouring, settings, nodes: as a text that can be compared."""
    limber = bpy.context.scene.limber
    things = sorted((thing.name, len(thing.data.vertices) if thing.type == "MESH" else 0)
                    for thing in bpy.context.scene.objects)
    skeleton = part("branch.branches").find_skeleton(bpy.context.scene)
    surface = part("branch.branches").find_surface(bpy.context.scene)
    radii = [] if skeleton is None else part("bridge.meshes").values_of(
        skeleton.data, "radius").round(6).tolist()
    colour = None if surface is None else surface.data.color_attributes.active_color.name
    return json.dumps([things, radii, colour, list(limber.plan.goal),
                       limber.estimate.pith_radius, limber.reconstruct.cloud])


def _until(ready, seconds: float, fail: bool = True):
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if found := ready():
            return found
        time.sleep(0.005)
    if fail:
        raise TimeoutError(f"not within {seconds} s")
    return None


def _memory_mb() -> float:
    """Private memory of this process [MB]."""
    fields = Path("/proc/self/statm").read_text().split()
    return (int(fields[1]) - int(fields[2])) * os.sysconf("SC_PAGE_SIZE") / 2**20


def main(settings: dict) -> None:
    """Register the add-on and measure the part that the settings name."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    say("blender", version=bpy.app.version_string)
    began = time.monotonic()
    registering(Path(settings["addon"]))
    branch, cloud = Path(settings["branch"]), Path(settings["cloud"])
    quick, name = settings["quick"], settings["part"]
    measures = {
        "register": lambda: None,
        "frame write": lambda: frame_write(50_000, 60 if quick else 400),
        "import": lambda: import_points(Path(settings["large_cloud"])),
        "grab": lambda: grab_loop(branch, 200 if quick else 1000),
        "job memory": lambda: job_memory(20 if quick else 100),
        "undo": lambda: undo_sequences(branch, cloud, 20 if quick else 200, settings["seed"],
                                       settings["seconds"] - (time.monotonic() - began))}
    try:
        measures[name]()
    except Exception:
        say(name, error=traceback.format_exc())
    sys.modules["limber_addon"].unregister()


if __name__ == "__main__":
    main(json.loads(Path(sys.argv[sys.argv.index("--") + 1]).read_text()))
