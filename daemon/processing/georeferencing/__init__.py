"""`swath georef`."""
