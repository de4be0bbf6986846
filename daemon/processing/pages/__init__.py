"""What all pages share: style, canvas, words."""
