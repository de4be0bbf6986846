"""The recorder: takes data from the wires and writes it to the log."""
