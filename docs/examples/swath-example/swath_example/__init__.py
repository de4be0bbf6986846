"""Drivers for Swath: a scanner and a receiver that do not exist."""
