"""Find what is wrong with hardware, computer and scene: the cause, and what to do."""
