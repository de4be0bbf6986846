"""The log (MCAP): layout, writing, reading, recovery. docs/log-format.md is its public page."""
