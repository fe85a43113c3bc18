"""The interactive session: a process that holds a branch, its client and its trainer."""
