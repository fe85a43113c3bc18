"""From pulls to Young's modulus along the branch: recordings, estimators, uncertainty."""
