"""Identification, check and setup of the configured devices."""
