"""Planes: their search, matching and fit."""
