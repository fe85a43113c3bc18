"""The material laws that can be exported to other programs."""

from limber.core.errors import InputError
from limber.mechanics.materials.laws import MaterialLaw, is_hookean_at_rest


def require_elastic(law: MaterialLaw, program: str, *, at_any_strain: bool = False) -> None:
    """Refuse a law that is not described by Young's modulus and Poisson's ratio alone.

    Args:
        program: The program that receives these two numbers.
        at_any_strain: Whether the program also computes large strains with them.

    Raises:
        InputError: it is another law.
    """
    if law.is_hookean or (not at_any_strain and is_hookean_at_rest(law)):
        return
    raise InputError(f"{program} does not support the material {law.name!r}.",
                     "The file can only state Young's modulus and Poisson's ratio, which do not "
                     "describe this law.",
                     "Export the branch with st_venant_kirchhoff.")
