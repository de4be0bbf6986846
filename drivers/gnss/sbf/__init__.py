"""Septentrio Binary Format."""
