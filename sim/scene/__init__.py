"""Terrain, village and objects, and the echoes of rays that meet them."""
