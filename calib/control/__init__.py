"""Control points and their judgement."""
