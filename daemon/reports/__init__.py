"""Reports that measure graspd itself: behind the `train` extra, never part of a running daemon."""
