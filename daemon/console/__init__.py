"""Serves the operator's console: pages that show what recorder and live write, and that ask the recorder for marks."""
