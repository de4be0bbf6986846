"""Implements `swath view`: a page of pictures of point files."""
