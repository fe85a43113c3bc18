"""The job file and the command lines that come from it."""
