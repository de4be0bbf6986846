"""Implements `swath trajectory`: files, figures, pages, verdict."""
