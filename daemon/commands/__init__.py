"""The commands of `graspd`, imported only when called."""
