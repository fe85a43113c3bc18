"""Point clouds: files, noise and what is no branch, made ready for a skeleton."""
