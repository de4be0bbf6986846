"""Implements `swath strips`: comparison and adjustment of overlapping strips."""
