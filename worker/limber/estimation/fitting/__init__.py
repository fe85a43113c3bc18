"""What an optimiser minimises, and the optimisers."""
