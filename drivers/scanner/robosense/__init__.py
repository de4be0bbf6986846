"""RoboSense spinning heads: models with their layouts, and the parser."""
