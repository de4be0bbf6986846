"""u-blox UBX: parser, messages and start-up."""
