"""Material laws, Young's modulus along the branch, strength of wood."""
