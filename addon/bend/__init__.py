"""Bend the branch by hand: a session of the worker follows the mouse."""
