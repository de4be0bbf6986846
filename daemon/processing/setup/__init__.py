"""What processing is set up with: sources, models, terrain."""
