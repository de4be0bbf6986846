"""Implements `swath live`: points and status while the recorder runs."""
