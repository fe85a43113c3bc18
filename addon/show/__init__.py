"""Show a branch: its scene, colours, legends, graphs and pictures."""
