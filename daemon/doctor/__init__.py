"""What is wrong with hardware, computer and scene, by cause, and what to do about it."""
