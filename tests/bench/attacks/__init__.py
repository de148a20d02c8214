"""Attacks that hostile peers may try on a daemon, and their results; run by `__main__`."""
