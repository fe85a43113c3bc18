"""The energy field over grasp poses: samples, radial basis functions, trusted region."""
