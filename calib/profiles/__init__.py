"""Profiles across the swath: scan angle errors measured step by step."""
