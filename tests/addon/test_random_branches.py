"""Three branches and random operators: nothing is written to another branch than the tab names.

``LIMBER_RANDOM_OPERATORS=500`` tries as many, with the seed ``LIMBER_RANDOM_SEED``.
"""

import json
import os
import random
import shutil
from pathlib import Path

import pytest
from tests.addon.conftest import Ended, part

COUNT = int(os.environ.get("LIMBER_RANDOM_OPERATORS", "40"))
WRITTEN = "written-by-the-test.json"


class Run:
    """A scene with three branches, and what may happen to it. Names of folders may change; what
    was written into which branch is told by the UUID in its folder."""

    def __init__(self, bpy, folders, seed):
        self.bpy, self.folders, self.chance = bpy, folders, random.Random(seed)
        self.written = {}
        for folder in folders:
            self.open(folder)
        self.library = folders[0].with_name("others.blend")
        self.kept = [one.name for one in self.shown()]
        bpy.data.libraries.write(str(self.library), {bpy.data.collections[name]
                                                     for name in self.kept})

    def uuid(self, folder):
        return json.loads((Path(folder) / "branch.json").read_text())["uuid"]

    def open(self, folder=None):
        folder = folder or self.chance.choice(self.folders)
        self.bpy.ops.limber.open_result(directory=str(folder))

    def shown(self):
        return [one for one in part("branch.branches").branches(self.bpy.context.scene)
                if part("branch.branches").surface_of(one) is not None]

    def switch(self):
        """Click any object of the scene, or none."""
        things = [*self.bpy.context.view_layer.objects, None]
        self.bpy.context.view_layer.objects.active = self.chance.choice(things)
        self.bpy.context.view_layer.update()

    def choose(self):
        settings = self.bpy.context.scene.limber
        items = part("properties")._branches_to_choose(settings, None)
        settings.branch = self.chance.choice(items)[0]

    def append(self):
        """Append a branch's collection from another file, as a user does from a colleague's."""
        name = self.chance.choice(self.kept)
        with self.bpy.data.libraries.load(str(self.library)) as (_, taken):
            taken.collections = [name]
        self.bpy.context.scene.collection.children.link(taken.collections[0])

    def rename(self):
        if self.shown():
            self.chance.choice(self.shown()).name = self.chance.choice(("a", "twig", "x.001"))

    def delete(self):
        """Delete a surface, or a whole collection, as the outliner does."""
        if not self.shown():
            return
        branch = self.chance.choice(self.shown())
        if self.chance.random() < 0.5:
            self.bpy.data.objects.remove(part("branch.branches").surface_of(branch))
        else:
            self.bpy.data.collections.remove(branch)

    def swap(self):
        """Two folders change places on the disk; the scene does not know."""
        one, other = self.chance.sample(self.folders, 2)
        aside = one.with_name("aside")
        one.rename(aside)
        other.rename(one)
        aside.rename(other)

    def undo(self):
        if self.bpy.ops.ed.undo.poll():
            self.bpy.ops.ed.undo()

    def redo(self):
        if self.bpy.ops.ed.redo.poll():
            self.bpy.ops.ed.redo()

    def write(self, operator, *, late=False, **given):
        """Press a button as it was drawn; ``late``: after another branch became current."""
        scene = self.bpy.context.scene
        named = part("branch.branches").current_uuid(scene)
        if not named:
            return
        if late:
            self.choose()
        name = f"{operator}{len(self.written)}"
        try:
            getattr(self.bpy.ops.limber, operator)(branch_uuid=named, name=name, **given)
        except RuntimeError as refused:
            assert any(words in str(refused) for words in
                       ("another branch now", "no longer in the scene")), refused
        else:
            self.written[name] = named

    def target(self):
        self.write("target", at=(0.0, 0.0, 0.3))

    def late_target(self):
        self.write("target", late=True, at=(0.0, 0.0, 0.3))

    def plan(self):
        """It samples the energy first, as the branch has none."""
        self.write("plan", late=self.chance.random() < 0.5, goal=(0.0, 0.1, 0.3))

    def check(self):
        """Each target is in the branch that was named as it was written, and nowhere else."""
        found = {}
        for folder in self.folders:
            path = folder / WRITTEN
            for each in json.loads(path.read_text()) if path.is_file() else ():
                found[each] = self.uuid(folder)
        assert found == self.written


@pytest.fixture()
def three(bpy, registered, tmp_path, bare_beam, monkeypatch):
    """Three branches with UUIDs of their own. The worker only writes down what it was to write."""
    folders = [tmp_path / f"{name}.branch" for name in "abc"]
    for number, folder in enumerate(folders):
        shutil.copytree(bare_beam.folder, folder)
        path = folder / "branch.json"
        content = json.loads(path.read_text()) | {"uuid": f"uuid-{number}"}
        path.write_text(json.dumps(content))
    return folders


@pytest.fixture()
def quick_worker(worker_here, monkeypatch):
    """``target`` and ``plan`` write their name into the folder that they are given, ``energy``
    writes nothing; all else is the real worker."""
    jobs = part("jobs.jobs")
    launch = jobs.Job.launch

    def launch_here(job):
        arguments = job.command[job.command.index("limber") + 1:]
        if arguments[0] not in ("target", "plan", "energy"):
            return launch(job)
        folder, *names = arguments[arguments.index("--") + 1:]
        if arguments[0] == "plan":
            names = [arguments[arguments.index("--name") + 1]]
        path = Path(folder) / WRITTEN
        written = json.loads(path.read_text()) if path.is_file() else []
        path.write_text(json.dumps([*written, *names]))
        job._process = Ended()
        job.state = jobs.JobState.RUNNING
        return None
    monkeypatch.setattr(jobs.Job, "launch", launch_here)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [int(os.environ.get("LIMBER_RANDOM_SEED", "1"))])
def test_random_operators_write_to_the_named_branch_alone(bpy, three, quick_worker, seed):
    """Opened, clicked, chosen, appended, renamed, deleted, undone, swapped on the disk, written."""
    run = Run(bpy, three, seed)
    kinds = ["open", "switch", "switch", "choose", "append", "rename", "delete", "swap",
             "target", "target", "late_target", "plan", "undo", "redo"]
    for _ in range(COUNT):
        kind = run.chance.choice(kinds)
        getattr(run, kind)()
        if kind not in ("undo", "redo"):
            # As Blender does after an operator of a button.
            bpy.ops.ed.undo_push(message=kind)
        run.check()
    assert len(run.written) > COUNT / 20, "too little was written to tell"
    assert len(set(run.written.values())) > 1
