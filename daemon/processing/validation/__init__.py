"""`swath validate`."""
