"""The light's path through the air: group index and refraction."""
