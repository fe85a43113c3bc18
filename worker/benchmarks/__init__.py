"""Benchmarks: one module per topic; each measures what an issue required, and hides nothing."""
