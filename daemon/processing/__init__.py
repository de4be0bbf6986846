"""Logs to products, after the flight and beside the recorder: imported by commands when they run, never by a recorder."""
