"""Judges of held grasps by their counts: pure, without time, for the daemon and for training."""
