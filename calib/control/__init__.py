"""Ground control points and checks of them."""
