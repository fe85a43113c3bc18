"""Benchmarks: one module a topic; each measures what an issue asked, and softens nothing."""
