"""Materials: one colour, a number on the vertices shown by a colour ramp, or wood."""

import json
import math

import bpy

from .. import compat

KEY = "limber_material"
"""Key of a material of ours: what it shows. It is made once a file, and then left to the user."""
_SCALE_KEY = "limber_scale"
_AXIS, _RANGE, _COLOURS = "Limber Axis", "Limber Range", "Limber Colours"
"""Names of the nodes that hold the scale of a scalar's material."""
WOOD = "wood"
_BARK = ([0.25, 0.035, 0.019, 0.010], [0.5, 0.16, 0.088, 0.043], [0.72, 0.33, 0.215, 0.125])
WOOD_COLOUR = tuple(_BARK[1][1:])
"""Linear colour of wood where no texture is drawn."""


def plain_material(name: str, color: tuple[float, float, float], *, alpha: float = 1.0,
                   roughness: float = 0.5, glow: float = 0.0) -> bpy.types.Material:
    """Return the material of one linear colour; ``alpha`` below 1 is transparent, ``glow`` is the
    strength of its own light."""
    key = f"{name} {tuple(color)} {alpha} {roughness}"
    if (known := _known(key)) is not None:
        return known
    material, shader = _new(name, key)
    shader.inputs["Base Color"].default_value = (*color, 1.0)
    shader.inputs["Roughness"].default_value = roughness
    shader.inputs["Alpha"].default_value = alpha
    shader.inputs["Emission Color"].default_value = (*color, 1.0)
    shader.inputs["Emission Strength"].default_value = glow
    # EEVEE draws it as noise otherwise.
    material.surface_render_method = "BLENDED" if alpha < 1.0 else "DITHERED"
    material.diffuse_color = (*color, alpha)
    return material


def vertex_color_material(name: str, attribute: str) -> bpy.types.Material:
    """Return the material that shows the colours of attribute ``attribute`` of the mesh."""
    key = f"{name} {attribute}"
    if (known := _known(key)) is not None:
        return known
    material, shader = _new(name, key)
    nodes, links = material.node_tree.nodes, material.node_tree.links
    color = nodes.new("ShaderNodeAttribute")
    color.attribute_name = attribute
    links.new(color.outputs["Color"], shader.inputs["Base Color"])
    shader.inputs["Roughness"].default_value = 0.5
    return material


def wood_material() -> bpy.types.Material:
    """Return the material of bark: furrows along the height of the branch at rest."""
    if (known := _known(WOOD)) is not None:
        return known
    material, shader = _new("Limber Wood", WOOD)
    nodes, links = material.node_tree.nodes, material.node_tree.links
    place, stretch, noise, ramp, bump = (nodes.new(f"ShaderNode{kind}") for kind in (
        "TexCoord", "Mapping", "TexNoise", "ValToRGB", "Bump"))
    stretch.inputs["Scale"].default_value = (90.0, 90.0, 12.0)
    noise.inputs["Scale"].default_value, noise.inputs["Detail"].default_value = 1.0, 8.0
    set_stops(ramp.color_ramp, _BARK)
    bump.inputs["Strength"].default_value, bump.inputs["Distance"].default_value = 0.5, 0.001
    # Of the shape at rest: the texture does not swim over a branch that bends.
    for source, target in (
            (place.outputs["Generated"], stretch.inputs["Vector"]),
            (stretch.outputs["Vector"], noise.inputs["Vector"]),
            (noise.outputs["Fac"], ramp.inputs["Fac"]),
            (noise.outputs["Fac"], bump.inputs["Height"]),
            (ramp.outputs["Color"], shader.inputs["Base Color"]),
            (bump.outputs["Normal"], shader.inputs["Normal"])):
        links.new(source, target)
    shader.inputs["Roughness"].default_value = 0.85
    material.diffuse_color = (*WOOD_COLOUR, 1.0)
    return material


def flat_material(name: str, color: tuple[float, float, float]) -> bpy.types.Material:
    """Return the material that shows its linear colour independent of the light: for a legend."""
    key = f"{name} {tuple(color)} flat"
    if (known := _known(key)) is not None:
        return known
    material, shader = _new(name, key)
    _make_flat(material, shader)
    material.node_tree.nodes["Emission"].inputs["Color"].default_value = (*color, 1.0)
    material.diffuse_color = (*color, 1.0)
    return material


def scalar_material(name: str, attribute: str, *, low: float, high: float, log: bool,
                    stops: list[list[float]], flat: bool = False, owner: str = "",
                    ) -> bpy.types.Material:
    """Return the material that shows FLOAT attribute ``attribute`` by colour, with this scale.

    Args:
        name: Name of the material.
        attribute: Attribute of the mesh, in its real unit.
        low: Value of the first colour.
        high: Value of the last colour.
        log: Whether the colours are spread over the logarithm.
        stops: Rows ``[position 0..1, red, green, blue]``, linear.
        flat: Whether it is independent of the light.
        owner: What the scale belongs to, by default the name: another has a material of its own.
    """
    key = f"{owner or name} {attribute} {flat}"
    found = _all_known(key) or [_new_scalar_material(name, key, attribute, flat=flat)]
    if log:
        low, high = math.log10(low), math.log10(high)
    scale = json.dumps([low, high, log, stops])
    for material in [material for material in found if material.get(_SCALE_KEY) != scale]:
        material[_SCALE_KEY] = scale
        nodes = material.node_tree.nodes
        # The user may have removed one.
        if (axis := nodes.get(_AXIS)) is not None:
            axis.operation = "LOGARITHM" if log else "MULTIPLY"
            axis.inputs[1].default_value = 10.0 if log else 1.0
        if (place := nodes.get(_RANGE)) is not None:
            place.inputs["From Min"].default_value = low
            place.inputs["From Max"].default_value = high
        if (ramp := nodes.get(_COLOURS)) is not None:
            set_stops(ramp.color_ramp, stops)
    return found[0]


def wear(thing: bpy.types.Object, material: bpy.types.Material, *, is_asked: bool = False) -> None:
    """Put a material of ours into the first slot of an object.

    Only instead of one of ours that shows something else, unless the user has asked for it.
    """
    if not thing.material_slots:
        if is_asked:
            thing.data.materials.append(material)
        return
    slot = thing.material_slots[0]
    before = None if slot.material is None else slot.material.get(KEY)
    if before != material[KEY] and (before is not None or is_asked):
        slot.material = material


def _new_scalar_material(name: str, key: str, attribute: str, *, flat: bool,
                         ) -> bpy.types.Material:
    material, shader = _new(name, key)
    nodes, links = material.node_tree.nodes, material.node_tree.links
    value, axis = nodes.new("ShaderNodeAttribute"), nodes.new("ShaderNodeMath")
    value.attribute_name = attribute
    place, ramp = nodes.new("ShaderNodeMapRange"), nodes.new("ShaderNodeValToRGB")
    axis.name, place.name, ramp.name = _AXIS, _RANGE, _COLOURS
    links.new(value.outputs["Fac"], axis.inputs[0])
    links.new(axis.outputs[0], place.inputs["Value"])
    links.new(place.outputs["Result"], ramp.inputs["Fac"])
    if flat:
        _make_flat(material, shader)
        links.new(ramp.outputs["Color"], nodes["Emission"].inputs["Color"])
    else:
        links.new(ramp.outputs["Color"], shader.inputs["Base Color"])
        # A little emission: the colour stays readable on the shaded side.
        links.new(ramp.outputs["Color"], shader.inputs["Emission Color"])
        shader.inputs["Emission Strength"].default_value = 0.12
        shader.inputs["Roughness"].default_value = 0.55
    return material


def _known(key: str) -> bpy.types.Material | None:
    return next(iter(_all_known(key)), None)


def _all_known(key: str) -> list[bpy.types.Material]:
    """Return a material of ours with the copies that the user has made of it."""
    return [material for material in bpy.data.materials
            if material.get(KEY) == key and material.library is None]


def _new(name: str, key: str) -> tuple[bpy.types.Material, bpy.types.Node]:
    material = bpy.data.materials.new(name)
    material[KEY] = key
    compat.use_nodes(material)
    nodes = material.node_tree.nodes
    shader = next(node for node in nodes if node.type == "BSDF_PRINCIPLED")
    return material, shader


def _make_flat(material: bpy.types.Material, shader: bpy.types.Node) -> None:
    nodes, links = material.node_tree.nodes, material.node_tree.links
    output = next(node for node in nodes if node.type == "OUTPUT_MATERIAL")
    nodes.remove(shader)
    emission = nodes.new("ShaderNodeEmission")
    emission.name = "Emission"
    links.new(emission.outputs["Emission"], output.inputs["Surface"])


def set_stops(ramp: bpy.types.ColorRamp, stops: list[list[float]]) -> None:
    """Set a ramp to rows ``[position 0..1, red, green, blue]``, linear."""
    while len(ramp.elements) > 1:
        ramp.elements.remove(ramp.elements[-1])
    for number, (position, *color) in enumerate(stops):
        element = ramp.elements[0] if number == 0 else ramp.elements.new(position)
        element.position = position
        element.color = (*color, 1.0)
