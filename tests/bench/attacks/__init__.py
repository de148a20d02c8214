"""What an attacker or a broken board may try, and what happens: see `__main__`."""
