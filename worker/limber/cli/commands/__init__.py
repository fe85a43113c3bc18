"""One module a command: it turns options into settings and calls one function of the core."""
