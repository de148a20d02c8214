"""Simulated hardware and grasps for tests and demonstrations; the daemon uses none."""

NAP_MAX_NS = 20_000_000
"""Longest sleep of a twin, ns; after it the twin looks whether it is to stop. It does not wait for
the event itself: a signal's handler that sets it would wait for its own thread's lock."""
