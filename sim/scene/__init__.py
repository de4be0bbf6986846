"""Terrain, village and objects, and rays that meet them."""
