"""The Python interface: what ``import limber`` gives, a verb for each command and its typed result.

It calls the stages as the command line does, and they write the same files. Nothing calls it.
"""
