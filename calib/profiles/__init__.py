"""Profiles across the swath: step-by-step measurement of angle errors."""
