"""Livox scanners: packets of both SDKs, whose points are x, y, z or two angles and a distance."""
