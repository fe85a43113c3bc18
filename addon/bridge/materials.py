"""Materials: one colour, or a number on the vertices shown by a colour ramp."""

import math

import bpy

from .. import compat


def plain_material(name: str, color: tuple[float, float, float], *, alpha: float = 1.0,
                   roughness: float = 0.5) -> bpy.types.Material:
    """Make a material of one linear colour; ``alpha`` below 1 is transparent."""
    material, shader = _new(name)
    shader.inputs["Base Color"].default_value = (*color, 1.0)
    shader.inputs["Roughness"].default_value = roughness
    shader.inputs["Alpha"].default_value = alpha
    material.diffuse_color = (*color, alpha)
    return material


def vertex_color_material(name: str, attribute: str) -> bpy.types.Material:
    """Make a material that shows the colours of attribute ``attribute`` of the mesh."""
    material, shader = _new(name)
    nodes, links = material.node_tree.nodes, material.node_tree.links
    color = nodes.new("ShaderNodeAttribute")
    color.attribute_name = attribute
    links.new(color.outputs["Color"], shader.inputs["Base Color"])
    shader.inputs["Roughness"].default_value = 0.5
    return material


def flat_material(name: str, color: tuple[float, float, float]) -> bpy.types.Material:
    """Make a material that shows its linear colour independent of the light: for a legend."""
    material, shader = _new(name)
    _make_flat(material, shader)
    material.node_tree.nodes["Emission"].inputs["Color"].default_value = (*color, 1.0)
    material.diffuse_color = (*color, 1.0)
    return material


def scalar_material(name: str, attribute: str, *, low: float, high: float, log: bool,
                    stops: list[list[float]], flat: bool = False) -> bpy.types.Material:
    """Make a material that shows FLOAT attribute ``attribute`` by colour.

    Args:
        name: Name of the material.
        attribute: Attribute of the mesh, in its real unit.
        low: Value of the first colour.
        high: Value of the last colour.
        log: Whether the colours are spread over the logarithm.
        stops: Rows ``[position 0..1, red, green, blue]``, linear.
        flat: Whether it is independent of the light.
    """
    material, shader = _new(name)
    nodes, links = material.node_tree.nodes, material.node_tree.links
    value = nodes.new("ShaderNodeAttribute")
    value.attribute_name = attribute
    output = value.outputs["Fac"]
    if log:
        logarithm = nodes.new("ShaderNodeMath")
        logarithm.operation = "LOGARITHM"
        logarithm.inputs[1].default_value = 10.0
        links.new(output, logarithm.inputs[0])
        output, low, high = logarithm.outputs[0], math.log10(low), math.log10(high)
    place = nodes.new("ShaderNodeMapRange")
    place.inputs["From Min"].default_value = low
    place.inputs["From Max"].default_value = high
    links.new(output, place.inputs["Value"])
    ramp = nodes.new("ShaderNodeValToRGB")
    set_stops(ramp.color_ramp, stops)
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


def _new(name: str) -> tuple[bpy.types.Material, bpy.types.Node]:
    material = bpy.data.materials.new(name)
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
