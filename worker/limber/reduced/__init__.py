"""The reduced model: basis, training, statics, motion, refresh."""
