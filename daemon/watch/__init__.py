"""Viewers of the daemon's messages: ordinary subscribers that draw in a terminal or a page."""
