"""Inertial units on CAN whose signals a DBC file describes."""
