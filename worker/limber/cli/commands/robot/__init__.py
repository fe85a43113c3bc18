"""Check, calibrate and move a robot: `limber robot check`, `goto-start`, `retreat` and others."""
