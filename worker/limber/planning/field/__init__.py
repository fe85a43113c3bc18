"""The energy field over grasp poses: samples, radial basis functions, where it is trusted."""
