"""Style, canvas and words that all HTML pages share."""
