"""The Python interface: the contents of ``import limber``, with a typed result for each command.

It calls the stages as the command line does, and they write the same files. No other module calls
it.
"""
