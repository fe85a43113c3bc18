"""Materials to start from, with where their numbers come from. No bpy.

Modulus of elasticity and of rupture of clear green stem wood: Wood Handbook (Forest Products
Laboratory, 2010), table 5-3a; density from its specific gravity there and the moisture of green
wood in table 4-1, heartwood and sapwood in equal parts.
"""

from dataclasses import dataclass

SOURCE = ("Wood Handbook 2010, tables 5-3a and 4-1: green stem wood. Branches are often softer: "
          "estimate")


@dataclass(frozen=True)
class Material:
    """What a branch may be made of: Young's modulus and strength [Pa], density [kg/m^3]."""

    title: str
    young: float
    strength: float
    density: float


MATERIALS = {
    "ash": Material("Ash, white", 9.9e9, 66e6, 798.0),
    "beech": Material("Beech, American", 9.5e9, 59e6, 916.0),
    "birch": Material("Birch, yellow", 10.3e9, 57e6, 952.0),
    "maple": Material("Maple, sugar", 10.7e9, 65e6, 944.0),
    "oak": Material("Oak, northern red", 9.3e9, 57e6, 977.0),
    "tulip": Material("Yellow-poplar", 8.4e9, 41e6, 778.0),
    "walnut": Material("Walnut, black", 9.8e9, 66e6, 926.0),
}
