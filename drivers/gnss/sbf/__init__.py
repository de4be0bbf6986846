"""Septentrio Binary Format: parser, blocks and start-up."""
