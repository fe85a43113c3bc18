"""From a cloud to a curve graph: Laplacian contraction and what follows it."""
