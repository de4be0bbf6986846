"""Parsers for corrections of base stations, one file for each protocol."""
