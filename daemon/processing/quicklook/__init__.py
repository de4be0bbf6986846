"""`swath view`."""
