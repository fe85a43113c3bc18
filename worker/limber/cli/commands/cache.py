"""Show or trim what is cached to be faster the next time."""

from typing import Any

import click

from limber.cli.main import Run, stage_command
from limber.core.errors import Option, Text


@stage_command("cache")
@click.option("--limit", metavar="SIZE", help=(
    "Remove the least recently used entries until the total is at most this size: 500 MB, 2 GB."))
@click.option("--clear", is_flag=True, help="Remove everything. It is computed again when needed.")
def command(run: Run, limit: str | None, clear: bool) -> dict[str, Any]:
    """Show what is cached (meshes, reduced models, compiled code), or trim it.

    No result is among it: branch folders do not need it.
    """
    from limber.core.errors import InputError
    from limber.core.files.caches import cache_folder, known_caches, trim
    from limber.core.files.caches import clear as clear_folder
    from limber.core.units import in_unit

    most = None
    if limit is not None:
        try:
            most = 1e6 * float(in_unit(limit, "MB"))
            if not 0 <= most < float("inf"):
                raise ValueError(limit)
        except (TypeError, ValueError) as error:
            raise InputError(Text(Option("limit"), f" {limit!r} is not a size."), "",
                             "Write 500 MB or 2 GB.") from error
    if clear:
        freed = clear_folder(cache_folder())
    else:
        freed = 0 if most is None else trim(cache_folder(), most)
    caches = known_caches()
    run.show(f"Kept in {cache_folder()}", [["what", "files", "MB"], *(
        [one.name, str(one.file_count), f"{one.byte_count / 1e6:.1f}"] for one in caches)])
    run.close(f"{sum(one.byte_count for one in caches) / 1e6:.1f} MB are kept, {freed / 1e6:.1f} "
              "MB were freed.", where=cache_folder())
    return {"folder": cache_folder(), "byte_count": sum(one.byte_count for one in caches),
            "freed_bytes": freed,
            "caches": {one.name: {"file_count": one.file_count, "byte_count": one.byte_count}
                       for one in caches}}
