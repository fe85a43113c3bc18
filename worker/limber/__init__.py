"""Limber: from the scan of a plant branch to a simulation that behaves like it.

The core and the headless worker. Nothing in this package imports ``bpy``: the Blender add-on
(folder ``addon``) is one of its callers, the command ``limber`` is another.
"""

from limber.core.threads import one_thread as _one_thread
from limber.version import VERSION as __version__

# Before any module of Limber loads a library, in each process: no result may depend on threads.
_one_thread()

__all__ = ["__version__"]
