"""The log (MCAP): layout, writing, reading and recovery. docs/log-format.md describes the format for users."""
