"""Point clouds: files, noise and removal of other objects, prepared for a skeleton."""
