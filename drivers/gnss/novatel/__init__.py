"""NovAtel OEM binary logs: parser, layouts and start-up."""
