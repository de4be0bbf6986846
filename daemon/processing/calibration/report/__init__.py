"""Builds the report of a calibration: contents, tables, pictures, HTML and PDF."""
