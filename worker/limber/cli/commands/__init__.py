"""One module per command: it turns options into settings and calls one function of the core."""
