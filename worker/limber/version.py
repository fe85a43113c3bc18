"""The version, in one place: pyproject, manifests and the add-on read it here."""

VERSION = "0.1.0"
