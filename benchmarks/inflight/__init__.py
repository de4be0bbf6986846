"""Benchmarks of what runs in flight beside the recorder: live processing and the console."""
