"""Files: atomic writes, checked reading, caches, and names that are safe as paths."""
