"""What the tactile image is, which networks judge it, and what they state about themselves."""
