"""The objects of a branch: found by an id wherever the user has put them, and changed in place.

Ours are the geometry of an object's mesh, the attributes that were given to it, a material of ours
in its first slot, its delta transform and the modifier of the motion. All else is the user's and
stays: name, transform, visibility, keys, modifiers, constraints, parents, collections, materials.
"""

import re
from dataclasses import dataclass, field
from uuid import uuid4

import bpy
import numpy as np

from ..bridge import animation, materials, meshes
from .branches import FOLDER_KEY, ID_KEY, NAME_KEY, SHOWS_KEY, branches, is_in, parts_of, token_of

_NEEDED = ("surface", "skeleton", "energy_field")
"""What other functions read the mesh of: the user cannot replace it."""


@dataclass
class ShownBranch:
    """A branch in a scene.

    Attributes:
        collection: Where new objects go.
        surface: The branch itself.
        objects: Its objects by what they show.
        frame_count: Number of frames of its motion.
        is_first: Whether the scene did not have it before.
        place: Where it was put beside other branches [m].
        start: Frame of the scene in which the motion starts.
        speed: Frames of the motion per frame of the scene.
        notes: What the user is to know of the change.
        before: Its objects by id that have not been put again.
    """

    collection: bpy.types.Collection
    surface: bpy.types.Object | None = None
    objects: dict[str, list[bpy.types.Object]] = field(default_factory=dict)
    frame_count: int = 1
    is_first: bool = False
    place: np.ndarray = field(default_factory=lambda: np.zeros(3))
    start: float = 1.0
    speed: float = 1.0
    notes: list[str] = field(default_factory=list)
    before: dict[str, bpy.types.Object] = field(default_factory=dict)
    _given: list[bpy.types.Mesh] = field(default_factory=list)
    _filled: dict[bpy.types.Mesh, bpy.types.Mesh] = field(default_factory=dict)
    """Meshes in the scene, and what each was given: the user may share one between two objects."""

    def find(self, kind: str, part: str = "") -> bpy.types.Object | None:
        """Return an object of this branch that was there before; None without."""
        return self.before.get(f"{self.collection[ID_KEY]}/{kind}/{part}")

    def put(self, kind: str, name: str, mesh: bpy.types.Mesh,
            material: bpy.types.Material | None = None, part: str = "",
            ) -> tuple[bpy.types.Object, bool]:
        """Show ``mesh`` by the object of this id.

        Args:
            kind: What it shows.
            name: Name, unless the user has given it another.
            mesh: A mesh just made, in the branch's frame [m].
            material: Its material, unless the user has given it another.
            part: Which of several of its kind.

        Returns:
            The object, and whether it is new: only then what the user may change is set.
        """
        thing, key = self.find(kind, part), f"{self.collection[ID_KEY]}/{kind}/{part}"
        self.before.pop(key, None)
        if thing is not None and thing.type != "MESH":
            # Converted by the user: it is no longer ours.
            del thing[ID_KEY]
            thing = None
        if mesh not in self._given:
            self._given.append(mesh)
        is_new = thing is None
        if is_new:
            thing = bpy.data.objects.new(name, mesh)
            thing[ID_KEY], thing[SHOWS_KEY], thing[NAME_KEY] = key, kind, name
            meshes.note_given(mesh)
            if material is not None:
                mesh.materials.clear()
                mesh.materials.append(material)
        else:
            self._change(thing, kind, name, mesh, material)
        if not is_in(bpy.context.scene, thing):
            # New, or taken out of this scene by the user.
            self.collection.objects.link(thing)
        thing.delta_location = self.place
        self.objects.setdefault(kind, []).append(thing)
        return thing, is_new

    def _change(self, thing: bpy.types.Object, kind: str, name: str, mesh: bpy.types.Mesh,
                material: bpy.types.Material | None) -> None:
        animation.stand_still(thing)
        if meshes.is_given(thing.data) and self._filled.setdefault(thing.data, mesh) == mesh:
            maps = set(thing.data.uv_layers.keys()) - set(mesh.uv_layers.keys())
            is_other = not meshes.has_same_faces(thing.data, mesh)
            if is_other and (maps or thing.data.shape_keys):
                self.notes.append(f"{thing.name} has another mesh now. Its UV maps and shape keys "
                                  "were of the earlier mesh and are lost")
                thing.shape_key_clear()
            weights = meshes.Weights(thing) if is_other and thing.vertex_groups else None
            meshes.give(thing.data, mesh, is_edited_kept=kind == "skeleton")
            if weights is not None:
                weights.put_back(thing)
        elif kind in _NEEDED:
            meshes.note_given(mesh)
            for one in thing.data.materials:
                mesh.materials.append(one)
            thing.data = mesh
        if material is not None:
            materials.wear(thing, material)
        if thing.get(NAME_KEY) != name:
            if re.sub(r"\.\d{3,}$", "", thing.name) == thing.get(NAME_KEY):
                thing.name = name
            thing[NAME_KEY] = name

    def end(self) -> None:
        """Remove objects that the branch no longer has, and data of ours that nothing uses."""
        for thing in self.before.values():
            remove(thing)
        for mesh in self._given:
            if not mesh.users:
                bpy.data.meshes.remove(mesh)
        remove_unused()


def begin(scene: bpy.types.Scene, branch: bpy.types.Collection | None, name: str, token: str,
          ) -> ShownBranch:
    """Return a branch to be shown in ``scene``, in its collection; made where there is none.

    Args:
        scene: Scene to show it in.
        branch: Its collection, if it is shown anywhere in the file.
        name: Name of a new collection.
        token: Identity of the branch; objects whose collection was deleted are found by it.
    """
    if branch is None:
        branch = bpy.data.collections.new(name)
        known = {other.get(ID_KEY) for other in bpy.data.collections}
        branch[ID_KEY] = token if token and token not in known else uuid4().hex
    is_first = branch not in scene.collection.children_recursive
    if is_first:
        scene.collection.children.link(branch)
    before = {key: thing for key, thing in parts_of(branch).items()
              if thing.override_library is None}
    return ShownBranch(branch, is_first=is_first, before=before)


def remove(thing: bpy.types.Object) -> None:
    """Remove an object that we made, with its data; what hangs on it keeps its place."""
    for child in thing.children:
        place = child.matrix_world.copy()
        child.parent = None
        child.matrix_world = place
    animation.stand_still(thing)
    moved = thing.animation_data
    # Of a branch the user may have keyed it, and given it other data.
    ours = [thing.data] if meshes.is_given(thing.data) else [] if ID_KEY in thing else [
        thing.data, moved and moved.action]
    bpy.data.objects.remove(thing)
    bpy.data.batch_remove([block for block in ours if block is not None and not block.users])


def remove_unused() -> None:
    """Remove meshes and materials of ours that nothing uses."""
    for block in [block for block in (*bpy.data.meshes, *bpy.data.materials)
                  if not block.users and block.library is None
                  and (materials.KEY in block or meshes.GIVEN_KEY in block)]:
        bpy.data.batch_remove([block])


def release_copies() -> None:
    """Leave what the user copied of a branch to the user: it is not changed any more.

    A branch that was copied with its scene is a branch of its own there.
    """
    originals: dict[str, bpy.types.Collection] = {}
    for branch in _oldest_first(bpy.data.collections):
        first = originals.setdefault(branch[ID_KEY], branch)
        if first == branch:
            continue
        token = "" if _scenes_of(first) & _scenes_of(branch) else uuid4().hex
        for thing in branch.all_objects:
            if token_of(thing) == first[ID_KEY] and first.all_objects.get(thing.name) != thing:
                _rename(thing, token)
        _rename(branch, token)
        if not token:
            branch.pop(FOLDER_KEY)
    seen: dict[str, bpy.types.Object] = {}
    for thing in _oldest_first(bpy.data.objects):
        if seen.setdefault(thing[ID_KEY], thing) != thing:
            _rename(thing, "")


def _rename(block: bpy.types.ID, token: str) -> None:
    """Give an object or a collection the id of another branch; none if it is empty."""
    if token:
        block[ID_KEY] = "/".join([token, *block[ID_KEY].split("/")[1:]])
    else:
        del block[ID_KEY]


def _oldest_first(blocks) -> list:
    """Return those with an id; Blender numbers a copy after its original until the file is closed,
    and no copy is saved with an id.
    """
    return sorted((block for block in blocks if ID_KEY in block and block.library is None),
                  key=lambda block: block.session_uid)


def _scenes_of(branch: bpy.types.Collection) -> set[bpy.types.Scene]:
    return {scene for scene in bpy.data.scenes if branch in branches(scene)}
