"""Seeing what the daemon says: a subscriber like any other, drawn in a terminal or in a page."""
