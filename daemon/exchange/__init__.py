"""Import, export and offload of recordings."""
