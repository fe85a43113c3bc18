"""The branch folder on disk: manifest, stages committed whole or not at all, locks, streams."""

from limber.store.branch import Branch, OpenStage
from limber.store.folder_state import damage_error, unlisted
from limber.store.journal import Stream, stream_lines
from limber.store.manifest import FORMAT_VERSION, program_versions

__all__ = ["FORMAT_VERSION", "Branch", "OpenStage", "Stream", "damage_error", "program_versions",
           "stream_lines", "unlisted"]
