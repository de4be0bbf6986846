"""Georeferencing while data come: clocks, path and scanners side by side."""
