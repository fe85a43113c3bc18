"""Import of recordings of other programs into the pull format, and the registry of their formats.
"""
