"""The commands of `graspd`, one module each, imported only when called."""
