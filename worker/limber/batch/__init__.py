"""Many branches at once: a job file says what is run on which, and running it again goes on."""
