"""Simulated hardware and grasps for tests and demonstrations; the daemon uses none."""
