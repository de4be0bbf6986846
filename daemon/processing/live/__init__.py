"""`swath live`."""
