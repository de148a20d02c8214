"""Attacks that hostile peers may try on a daemon, and their results: see `__main__`."""
