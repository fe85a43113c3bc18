"""The branch folder on disk: manifest, stages that enter whole or not at all, checksums."""

from limber.store.branch import (
    FORMAT_VERSION,
    GRAVITY,
    MANIFEST,
    Alignment,
    Branch,
    BranchFolderError,
    Stage,
    file_digest,
    plain,
    program_versions,
    write_atomically,
)

__all__ = [
    "FORMAT_VERSION", "GRAVITY", "MANIFEST", "Alignment", "Branch", "BranchFolderError", "Stage",
    "file_digest", "plain", "program_versions", "write_atomically",
]
