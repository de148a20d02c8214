"""What a held grasp is worth by its counts: pure, without time, for the daemon and for training."""
