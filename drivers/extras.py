"""Words for what installs a package that is not there."""

from __future__ import annotations


def how_to_install(extras: str) -> str:
    """Return Swath is on no index: its extras are installed from its folder, into the environment it runs in."""
    return f"pip install '.[{extras}]' in the folder of Swath's sources"
