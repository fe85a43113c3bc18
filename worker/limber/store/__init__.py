"""The branch folder on disk: manifest, stages that enter whole or not at all, locks, streams."""

from limber.core.alignment import Alignment
from limber.core.constants import GRAVITY
from limber.core.files.atomic import file_digest, write_atomically
from limber.core.json_values import plain
from limber.store.branch import Branch, BranchFolderError, Stage
from limber.store.growing_files import Stream, stream_lines
from limber.store.manifest import FORMAT_VERSION, MANIFEST, program_versions
from limber.store.verify import Damage, damage_error, unlisted

__all__ = [
    "FORMAT_VERSION", "GRAVITY", "MANIFEST", "Alignment", "Branch", "BranchFolderError", "Damage",
    "Stage", "Stream", "damage_error", "file_digest", "plain", "program_versions", "stream_lines",
    "unlisted", "write_atomically",
]
