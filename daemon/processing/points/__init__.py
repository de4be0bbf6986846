"""From logs to points: feed, jobs, workers."""
