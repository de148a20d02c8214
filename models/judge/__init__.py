"""Judges of held grasps by their counts, without clock or I/O, for the daemon and for training."""
