"""Material laws by name: built-in and external.

An external law is known to a program that calls :func:`register_material`. An installed package
registers its laws for every command by the entry point group ``limber.materials``: a name, and the
location of an object or class of :class:`~limber.mechanics.materials.law.MaterialLaw`. Heavy
imports are delayed until a law is requested.
"""

import re
from importlib.metadata import entry_points
from typing import TYPE_CHECKING

from limber.core.errors import InputError

if TYPE_CHECKING:
    from limber.mechanics.materials.law import MaterialLaw

BUILT_IN = ("st_venant_kirchhoff", "stable_neo_hookean", "linear")
_GROUP = "limber.materials"
_registered: dict[str, "MaterialLaw"] = {}


def register_material(law: "MaterialLaw") -> "MaterialLaw":
    """Register a law under its name, replacing an earlier external one; return it.

    Raises:
        InputError: the name cannot be an option's value or is a built-in law's, the law claims a
            property reserved for built-in laws, or its methods are inconsistent (see
            :func:`limber.mechanics.materials.law.check_law`).
    """
    from limber.mechanics.materials.law import check_law

    name = getattr(law, "name", "")
    if not re.fullmatch(r"[a-z]\w*", name) or name in BUILT_IN:
        raise InputError(f"{name!r} is not a valid material name.",
                         "A name has only lower-case letters, digits and _, and differs from the "
                         "built-in names.",
                         "Choose another.")
    if law.is_compiled or law.is_linear or law.is_hookean or law.has_cubic_force or law.kernel:
        raise InputError(f"The material {name!r} declares itself built-in.",
                         "The kernels do not implement it.", "Do not change those attributes.")
    check_law(law)
    _registered[name] = law
    return law


def material_names() -> tuple[str, ...]:
    """Return the names of all laws; imports none of them."""
    return tuple(dict.fromkeys((*BUILT_IN, *_registered, *entry_points(group=_GROUP).names)))


def material_named(name: "str | MaterialLaw") -> "MaterialLaw":
    """Return the law of that name; a law is returned unchanged.

    Raises:
        InputError: there is no law of that name, or a package's law cannot be used.
    """
    if not isinstance(name, str):
        return name
    if name in BUILT_IN:
        from limber.mechanics.materials.built_in import LAWS

        return LAWS[BUILT_IN.index(name)]
    if name in _registered:
        return _registered[name]
    for entry in entry_points(group=_GROUP, name=name):
        found = entry.load()
        law = found() if isinstance(found, type) else found
        if law.name != name:
            raise InputError(f"{entry.value} has the name {law.name!r}, not {name!r}.",
                             "Its entry point has a different name.", "Give both the same name.")
        return register_material(law)
    raise InputError(f"There is no material {name!r}.", "The known materials are: "
                     + ", ".join(material_names()) + ".",
                     "Choose one, or register it (limber.mechanics.register_material).")
