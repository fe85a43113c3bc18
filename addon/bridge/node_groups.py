"""Modifiers of geometry nodes for the user's own things: a branch's motion, and styles that can be
restyled. Each is an asset of the file, made once, and then the user's.
"""

from collections.abc import Callable, Mapping

import bpy

from .materials import plain_material, set_stops, vertex_color_material, wood_material

ATTRIBUTE = "limber_color"
"""Colour attribute that a style writes, and that its material shows."""
REST = "rest_position"
"""Attribute of a branch's surface: where each vertex is at rest, in the branch's frame [m]."""
_PLAIN, _WIRE = (0.26, 0.52, 0.89, 1.0), (0.02, 0.09, 0.16)


class _Group:
    """A group that is being made, between its inputs and the geometry that it gives."""

    def __init__(self, title: str, about: str):
        self.tree = bpy.data.node_groups.new(title, "GeometryNodeTree")
        self.tree.is_modifier = True
        self.tree.asset_mark()
        self.tree.asset_data.description = about
        self.tree.asset_data.tags.new("Limber")
        self.tree.interface.new_socket("Geometry", in_out="OUTPUT",
                                       socket_type="NodeSocketGeometry")
        self._given = self.tree.nodes.new("NodeGroupInput")
        self.geometry = self.input("Geometry", "Geometry")

    def input(self, name: str, kind: str, default=None, attribute: str = "",
              ) -> bpy.types.NodeSocket:
        """Add an input; ``attribute`` is what a new modifier takes its values from."""
        socket = self.tree.interface.new_socket(name, in_out="INPUT",
                                                socket_type=f"NodeSocket{kind}")
        if default is not None:
            socket.default_value = default
        if attribute:
            socket.default_attribute_name = attribute
        return self._given.outputs[name]

    def add(self, kind: str, inputs: Mapping[str | int, object] | None = None,
            **properties: object) -> bpy.types.NodeSocket:
        """Add a node with ``inputs``, sockets or values; returns its first output."""
        node = self.tree.nodes.new(kind)
        for name, value in properties.items():
            setattr(node, name, value)
        for name, value in (inputs or {}).items():
            if isinstance(value, bpy.types.NodeSocket):
                self.tree.links.new(value, node.inputs[name])
            else:
                node.inputs[name].default_value = value
        return node.outputs[0] if node.outputs else None

    def named(self, attribute: str) -> bpy.types.NodeSocket:
        """Add the vectors of an attribute."""
        return self.add("GeometryNodeInputNamedAttribute", {"Name": attribute},
                        data_type="FLOAT_VECTOR")

    def store(self, geometry: bpy.types.NodeSocket, name: str, value: bpy.types.NodeSocket,
              kind: str, domain: str = "POINT") -> bpy.types.NodeSocket:
        """Add what writes an attribute."""
        return self.add("GeometryNodeStoreNamedAttribute", {
            "Geometry": geometry, "Name": name, "Value": value}, data_type=kind, domain=domain)

    def colour(self, geometry: bpy.types.NodeSocket, value: bpy.types.NodeSocket,
               ) -> bpy.types.NodeSocket:
        """Add the colours, and a material, which is an input, that shows them."""
        return self.wear(self.store(geometry, ATTRIBUTE, value, "FLOAT_COLOR"),
                         bpy.data.materials.get(ATTRIBUTE) or
                         vertex_color_material(ATTRIBUTE, ATTRIBUTE))

    def wear(self, geometry: bpy.types.NodeSocket, material: bpy.types.Material,
             ) -> bpy.types.NodeSocket:
        """Add a material, which is an input."""
        return self.add("GeometryNodeSetMaterial", {
            "Geometry": geometry, "Material": self.input("Material", "Material", material)})

    def end(self, geometry: bpy.types.NodeSocket) -> None:
        """Give this geometry."""
        self.add("NodeGroupOutput", {"Geometry": geometry})
        for number, node in enumerate(self.tree.nodes):
            node.location = 220.0 * (number // 4), -180.0 * (number % 4)


def _made(title: str, about: str, make: Callable[[_Group], bpy.types.NodeSocket],
          ) -> bpy.types.NodeTree:
    """Return the group of this title; made where the file has none."""
    known = bpy.data.node_groups.get(title)
    if known is not None:
        return known
    group = _Group(title, about)
    group.end(make(group))
    return group.tree


def colour_group(name: str, stops: list[list[float]]) -> bpy.types.NodeTree:
    """Return the group that colours by a colour map.

    Args:
        name: Name of the colour map.
        stops: Rows ``[position 0..1, red, green, blue]``, linear.
    """
    def make(group: _Group) -> bpy.types.NodeSocket:
        given = {"Value": group.input("Quantity", "Float", attribute="young"),
                 "From Min": group.input("Low", "Float", 0.0),
                 "From Max": group.input("High", "Float", 1.0)}
        is_log = group.input("Logarithmic", "Bool", False)
        place = group.add("ShaderNodeMapRange", {
            target: group.add("GeometryNodeSwitch", {
                "Switch": is_log, "False": value, "True": group.add(
                    "ShaderNodeMath", {0: value, 1: 10.0}, operation="LOGARITHM")},
                input_type="FLOAT")
            for target, value in given.items()})
        ramp = group.add("ShaderNodeValToRGB", {"Fac": place})
        set_stops(ramp.node.color_ramp, stops)
        return group.colour(group.geometry, ramp)
    return _made(f"Limber Colours, {name}",
                 "Colours a branch by one of its attributes, such as young [Pa], from Low to High: "
                 f"writes {ATTRIBUTE}, and shows it by the material", make)


def add_styles() -> None:
    """Add the groups that move and style things."""
    _made("Limber Motion", "Bends anything along with a branch, from where it is at rest: a model "
          "of its bark, or leaves scattered over it, which turn too", _move)
    _made("Limber Wood", "Tubes of wood along a skeleton, as thick as its attribute radius says",
          lambda group: _tubes(group, wood_material(), 12, attribute="radius"))
    _made("Limber Wires", "Thin tubes along a skeleton or other edges",
          lambda group: _tubes(group, plain_material("Limber Wires", _WIRE), 6))
    _made("Limber Points", "A scan as balls in its colours", _points)


def _move(group: _Group) -> bpy.types.NodeSocket:
    """Each point keeps its place relative to the nearest face of the branch, which is taken from
    the branch at rest: moved with the face's point, and turned as the face is.
    """
    place = group.add("GeometryNodeInputPosition")
    branch = group.add("GeometryNodeObjectInfo", {"Object": group.input("Branch", "Object")},
                       transform_space="RELATIVE").node
    corners = [group.add("GeometryNodeFieldAtIndex", {
        "Value": place, "Index": group.add("GeometryNodeVertexOfCorner", {
            0: group.add("GeometryNodeCornersOfFace", {"Sort Index": number})})},
        data_type="FLOAT_VECTOR", domain="POINT") for number in (0, 1)]
    edge = group.add("ShaderNodeVectorMath", {0: corners[1], 1: corners[0]}, operation="SUBTRACT")
    values = {"place": (place, "POINT"), "edge": (edge, "FACE"),
              "normal": (group.add("GeometryNodeInputNormal"), "FACE")}
    mesh = branch.outputs["Geometry"]
    for state in ("moved", "rest"):
        if state == "rest":
            mesh = group.add("GeometryNodeSetPosition", {
                "Geometry": mesh, "Position": group.add("FunctionNodeTransformPoint", {
                    "Vector": group.named(REST), "Transform": branch.outputs["Transform"]})})
        for name, (value, domain) in values.items():
            mesh = group.store(mesh, f"limber_{state}_{name}", value, "FLOAT_VECTOR", domain)
    near = {state: {name: group.add("GeometryNodeSampleNearestSurface", {
        "Mesh": mesh, "Value": group.named(f"limber_{state}_{name}")}, data_type="FLOAT_VECTOR")
        for name in values} for state in ("moved", "rest")}
    stood, stands = (group.add("FunctionNodeAxesToRotation", {
        "Primary Axis": near[state]["normal"], "Secondary Axis": near[state]["edge"]})
        for state in ("rest", "moved"))
    turn = group.add("FunctionNodeRotateRotation", {
        0: group.add("FunctionNodeInvertRotation", {0: stood}), 1: stands})
    beside = group.add("ShaderNodeVectorMath", {0: place, 1: near["rest"]["place"]},
                       operation="SUBTRACT")
    moved = group.add("ShaderNodeVectorMath", {
        0: near["moved"]["place"], 1: group.add("FunctionNodeRotateVector", {0: beside, 1: turn})},
        operation="ADD")
    # Without a branch everything stays.
    is_there = near["moved"]["place"].node.outputs["Is Valid"]
    turned = group.add("GeometryNodeRotateInstances", {
        "Instances": group.geometry, "Selection": is_there, "Rotation": turn,
        "Pivot Point": place, "Local Space": False})
    return group.add("GeometryNodeSetPosition", {
        "Geometry": turned, "Selection": is_there, "Position": moved})


def _tubes(group: _Group, material: bpy.types.Material, sides: int, attribute: str = "",
           ) -> bpy.types.NodeSocket:
    radius = group.add("ShaderNodeMath", {
        0: group.input("Radius", "Float", 0.001, attribute), 1: group.input("Scale", "Float", 1.0)},
        operation="MULTIPLY")
    ring = group.add("GeometryNodeCurvePrimitiveCircle", {
        "Resolution": group.input("Sides", "Int", sides), "Radius": 1.0})
    curve = group.add("GeometryNodeSetCurveRadius", {
        "Curve": group.add("GeometryNodeMeshToCurve", {0: group.geometry}), "Radius": radius})
    tube = group.add("GeometryNodeCurveToMesh", {
        "Curve": curve, "Profile Curve": ring, "Fill Caps": True})
    if "Scale" in tube.node.inputs:
        # Blender 5 takes the radius only where it is told to.
        group.tree.links.new(group.add("GeometryNodeInputRadius"), tube.node.inputs["Scale"])
    return group.wear(tube, material)


def _points(group: _Group) -> bpy.types.NodeSocket:
    balls = group.add("GeometryNodeMeshToPoints", {
        "Mesh": group.geometry, "Radius": group.input("Radius", "Float", 0.001)})
    return group.colour(balls, group.input("Colour", "Color", _PLAIN, "scan_color"))
