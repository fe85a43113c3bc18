"""A modifier of geometry nodes that colours by a quantity, as an asset of the file."""

import bpy

from .materials import set_stops, vertex_color_material

ATTRIBUTE = "limber_color"
"""Colour attribute that the modifier writes."""
_DESCRIPTION = ("Colours a branch by one of its attributes, such as young [Pa], from Low to High: "
                f"writes {ATTRIBUTE}, and shows it by the material")


def colour_group(name: str, stops: list[list[float]]) -> bpy.types.NodeTree:
    """Return the node group that colours by a colour map, marked as an asset; made once a file.

    Args:
        name: Name of the colour map.
        stops: Rows ``[position 0..1, red, green, blue]``, linear.
    """
    title = f"Limber Colours, {name}"
    known = bpy.data.node_groups.get(title)
    if known is not None:
        return known
    group = bpy.data.node_groups.new(title, "GeometryNodeTree")
    group.is_modifier = True
    _add_sockets(group)
    _add_nodes(group, stops)
    group.asset_mark()
    group.asset_data.description = _DESCRIPTION
    group.asset_data.tags.new("Limber")
    return group


def _add_sockets(group: bpy.types.NodeTree) -> None:
    def new(name: str, kind: str, default=None, direction: str = "INPUT"):
        socket = group.interface.new_socket(name, in_out=direction, socket_type=f"NodeSocket{kind}")
        if default is not None:
            socket.default_value = default
        return socket
    new("Geometry", "Geometry", direction="OUTPUT")
    new("Geometry", "Geometry")
    new("Quantity", "Float").default_attribute_name = "young"
    new("Low", "Float", 0.0)
    new("High", "Float", 1.0)
    new("Logarithmic", "Bool", False)
    new("Material", "Material", bpy.data.materials.get(ATTRIBUTE) or
        vertex_color_material(ATTRIBUTE, ATTRIBUTE))


def _add_nodes(group: bpy.types.NodeTree, stops: list[list[float]]) -> None:
    nodes, links = group.nodes, group.links
    given, place = nodes.new("NodeGroupInput"), nodes.new("ShaderNodeMapRange")
    for source, target in (("Quantity", "Value"), ("Low", "From Min"), ("High", "From Max")):
        logarithm, chosen = nodes.new("ShaderNodeMath"), nodes.new("GeometryNodeSwitch")
        logarithm.operation, logarithm.inputs[1].default_value = "LOGARITHM", 10.0
        chosen.input_type = "FLOAT"
        links.new(given.outputs[source], logarithm.inputs[0])
        links.new(given.outputs["Logarithmic"], chosen.inputs["Switch"])
        links.new(given.outputs[source], chosen.inputs["False"])
        links.new(logarithm.outputs[0], chosen.inputs["True"])
        links.new(chosen.outputs["Output"], place.inputs[target])
    ramp, store = nodes.new("ShaderNodeValToRGB"), nodes.new("GeometryNodeStoreNamedAttribute")
    set_stops(ramp.color_ramp, stops)
    store.data_type, store.domain = "FLOAT_COLOR", "POINT"
    store.inputs["Name"].default_value = ATTRIBUTE
    shown, result = nodes.new("GeometryNodeSetMaterial"), nodes.new("NodeGroupOutput")
    links.new(place.outputs["Result"], ramp.inputs["Fac"])
    links.new(ramp.outputs["Color"], store.inputs["Value"])
    links.new(given.outputs["Geometry"], store.inputs["Geometry"])
    links.new(store.outputs["Geometry"], shown.inputs["Geometry"])
    links.new(given.outputs["Material"], shown.inputs["Material"])
    links.new(shown.outputs["Geometry"], result.inputs["Geometry"])
    for number, node in enumerate(nodes):
        node.location = 220.0 * (number // 3), -180.0 * (number % 3)
