"""The swath process: configuration, acquisition, log, replay, health checks and the command line."""
