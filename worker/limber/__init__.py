"""Limber: from the scan of a plant branch to a simulation that behaves like it.

The core and the headless worker. Nothing in this package imports ``bpy``: the Blender add-on
(folder ``addon``) is one of its callers, the command ``limber`` is another.
"""

from limber.version import VERSION as __version__

__all__ = ["__version__"]
