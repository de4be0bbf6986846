"""Sets processing up from a configuration: sources, models, terrain."""
