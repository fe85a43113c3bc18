"""Online estimates during a pull."""
