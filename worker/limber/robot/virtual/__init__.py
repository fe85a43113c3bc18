"""A Universal Robots controller in software, which the real client library connects to."""
