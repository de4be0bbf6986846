"""Xsens MTi over serial: Xbus, with the receiver of an MTi-G or MTi-600 with GNSS."""
