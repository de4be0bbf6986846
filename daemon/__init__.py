"""The process: configuration, acquisition, log, replay, health and the command line."""
