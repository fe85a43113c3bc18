"""A Universal Robots controller in software, to which the real client library connects."""
