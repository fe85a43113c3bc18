"""Many branches at once: a job file states what to run on which; a second run continues."""
