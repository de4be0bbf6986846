"""Gives the user instructions for installing optional packages."""

from __future__ import annotations


def how_to_install(extras: str) -> str:
    """Return the command that installs extras."""
    return f"pip install '.[{extras}]' in the folder of Swath's sources"
