"""Young's modulus and damping from vibrations: free swings and ringing."""
