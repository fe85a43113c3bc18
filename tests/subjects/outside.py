"""A package that is installed beside Limber, with one of each extension and their entry points."""

import os
import sys
from pathlib import Path

from limber.geometry.io.clouds import CLOUDS
from limber.stages import registry
from limber.stages.results.export import EXPORTS

ROOT = Path(__file__).parents[2]
STAGE = '''from typing import Any, ClassVar

from pydantic import Field

from limber.core.progress import SILENT, Progress
from limber.core.settings import Groups
from limber.stages.result import Result, shown
from limber.stages.stage import About, BranchStage, Repeatable
from limber.store import Branch
from limber.store.loading import load_skeleton


class Counted(Result):
    """Nodes of the skeleton."""

    heading = "Counted"
    node_count: int = shown("nodes", ",")

    def sentences(self, branch: Branch) -> list[str]:
        return [f"It has {self.node_count} nodes."]


class Count(Repeatable, BranchStage):
    """Count the nodes of the skeleton.

    Of every axis.
    """

    about = About("count", 27, Counted, key="count", reads=("skeleton.swc",),
                  writes=("count.txt",), step="skeleton", label="Count the Nodes")
    groups: ClassVar[Groups] = {"counting": ("least_radius",)}

    least_radius: float = Field(0.0, ge=0, description="Of the thicker ones alone [m].")

    def run(self, progress: Progress = SILENT) -> dict[str, Any]:
        branch = Branch.open(self.branch_folder)
        count = int((load_skeleton(branch).radius >= self.least_radius).sum())
        with branch.stage("count", self) as stage:
            stage.path("count.txt").write_text(str(count))
            stage.result = {"node_count": count}
        return branch.manifest.stages["count"].result
'''
THINGS = '''from dataclasses import replace

import numpy as np

from limber.geometry.io.formats import Format, starts_with
from limber.mechanics import MaterialLaw
from limber.planning.planners.rrt_star import Searched
from limber.store.loading import load_skeleton


def read_dots(path):
    points = np.frombuffer(path.read_bytes()[4:], "<f8").reshape(-1, 3)
    return dict(zip("xyz", points.T, strict=True))


def write_nodes(branch, path, settings, progress):
    skeleton = load_skeleton(branch)
    np.savetxt(path, skeleton.nodes)
    return {"node_count": skeleton.node_count}


def even_radii(skeleton, points, settings):
    return replace(skeleton, radius=np.full(skeleton.node_count, 0.006))


class Spruce(MaterialLaw):
    name = "spruce"

    def energy(self, strain, lame_lambda, lame_mu):
        trace = strain[..., :3].sum(axis=-1)
        return (0.5 * lame_lambda * trace**2
                + 2 * lame_mu * (strain**2 @ [1.0, 1, 1, 2, 2, 2]))


class Line:
    """The straight line to the goal; it grows no tree."""

    searched = []

    def missing(self):
        return ""

    def search(self, problem, search, progress):
        self.searched.append(problem)
        return Searched(np.linspace(problem.start, problem.goals[0], 20))


DOTS = Format("dots", (".foo",), read_dots, recognises=starts_with(b"dots"))
NODES = Format("nodes", (".nodes",), write=write_nodes, about="one row a node")
'''
ENTRIES = """[limber.stages]
count = outside.count:Count
[limber.clouds]
dots = outside.things:DOTS
broken = outside.things:NOTHING
[limber.exports]
nodes = outside.things:NODES
[limber.radii]
even = outside.things:even_radii
[limber.materials]
spruce = outside.things:Spruce
pine = outside.things:Spruce
[limber.planners]
line = outside.things:Line
"""


def install(folder, monkeypatch) -> Path:
    """Write it into a folder where Python finds packages, also that of started programs."""
    for name, text in {"outside/__init__.py": "", "outside/count.py": STAGE,
                       "outside/things.py": THINGS,
                       "outside-1.0.dist-info/METADATA": "Name: outside\nVersion: 1.0\n",
                       "outside-1.0.dist-info/entry_points.txt": ENTRIES}.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    monkeypatch.syspath_prepend(folder)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(folder), str(ROOT / "worker")]))
    for formats in (CLOUDS, EXPORTS):
        monkeypatch.setattr(formats, "formats", [*formats.formats])
        monkeypatch.setattr(formats, "_is_complete", False)
    forget()
    return folder


def forget() -> None:
    """Forget what it has brought; its modules too."""
    registry._stages.cache_clear()
    registry.result_kinds.cache_clear()
    for name in ("outside", "outside.count", "outside.things"):
        sys.modules.pop(name, None)
