"""Show or trim what is cached to be faster the next time."""

from typing import Any

from limber.cli.terminal import table_text
from limber.core.files import caches
from limber.core.progress import SILENT, Progress
from limber.stages.stage import About, Tool, option


class Cache(Tool):
    """Show what is cached (meshes, reduced models), or trim it.

    No result is among it: branch folders do not need it.
    """

    about = About("cache", found=("{byte_count:MB} are kept, {freed_bytes:MB} were freed.",))

    limit: float | None = option(
        "Remove the least recently used entries until the total is at most this, such as 2 GB "
        "[MB].", ge=0)
    clear: bool = option("Remove everything. It is computed again when needed.", False, switch=True)

    def run(self, progress: Progress = SILENT) -> dict[str, Any]:
        folder, freed = caches.cache_folder(), 0
        if self.limit is not None:
            freed = 0 if self.clear else caches.trim(folder, 1e6 * self.limit)
        if self.clear:
            freed = caches.clear(folder)
        known = caches.known_caches()
        progress.say(table_text(f"Kept in {folder}", [["what", "files", "MB"], *(
            [one.name, str(one.file_count), f"{one.byte_count / 1e6:.1f}"] for one in known)]))
        return {"folder": folder, "byte_count": sum(one.byte_count for one in known),
                "freed_bytes": freed,
                "caches": {one.name: {"file_count": one.file_count, "byte_count": one.byte_count}
                           for one in known}}
