"""GNSS receivers: one file a protocol."""
