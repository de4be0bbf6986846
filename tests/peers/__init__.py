"""Programs of others beside ours: gpsd, and the reader that Foxglove's viewer is built on. ``make test-peers``."""
