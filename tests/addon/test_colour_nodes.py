"""The modifier that colours by a quantity: an asset of each file that shows a branch."""

import numpy as np
import pytest

pytestmark = pytest.mark.usefixtures("worker_here")


@pytest.mark.slow
@pytest.mark.parametrize("scalar", ["young", "strain_energy"])
def test_it_colours_as_the_worker_does(bpy, registered, beam, scalar):
    """By the attribute of the surface, on a logarithmic or an even scale: the worker's colours."""
    from limber_addon.branch.branches import find_surface, info_of
    from limber_addon.bridge import colour_nodes, meshes

    bpy.ops.limber.open_result(directory=str(beam.folder))
    surface = find_surface(bpy.context.scene)
    scale = info_of(surface)["scalars"][scalar]
    group = bpy.data.node_groups[f"Limber Colours, {scale['colours']}"]
    assert group.asset_data is not None and group.is_modifier
    assert colour_nodes.colour_group(scale["colours"], scale["stops"]) == group, "once a file"
    surface.modifiers.clear()
    modifier = surface.modifiers.new("Colours", "NODES")
    modifier.node_group = group
    names = {item.name: item.identifier for item in group.interface.items_tree
             if item.in_out == "INPUT"}
    for name, value in (("Low", scale["low"]), ("High", scale["high"]),
                        ("Logarithmic", scale["log"])):
        modifier[names[name]] = value
    modifier[f"{names['Quantity']}_attribute_name"] = scalar
    modifier[f"{names['Quantity']}_use_attribute"] = True
    shown = surface.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
    colours = [np.empty(4 * len(shown.vertices), np.float32) for _ in range(2)]
    shown.attributes[colour_nodes.ATTRIBUTE].data.foreach_get("color", colours[0])
    surface.data.attributes[f"{scalar}_color"].data.foreach_get("color", colours[1])
    assert np.ptp(meshes.scalars(surface.data, scalar)) > 0
    np.testing.assert_allclose(*colours, atol=2e-3)
    drawn = shown.materials[shown.polygons[0].material_index]
    assert drawn.name == colour_nodes.ATTRIBUTE
