"""Turns logs into products, after the flight and beside the recorder; recorders never import this package."""
