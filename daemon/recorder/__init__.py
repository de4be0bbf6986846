"""The recorder: from wires to the log."""
