"""The light's way through the air: group index and refraction."""
