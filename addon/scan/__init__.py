"""Import a scan: read it, show its points, leave some out."""
