"""`swath strips`."""
