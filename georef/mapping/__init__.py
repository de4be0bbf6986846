"""The mapping frame: projection, datums, cells."""
