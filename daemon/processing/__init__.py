"""Logs to products, after the flight and beside the recorder; imported by commands that run, never by a recorder."""
