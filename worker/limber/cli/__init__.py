"""The command ``limber``: its entry point and the commands that are not stages."""
