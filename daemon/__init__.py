"""The daemon: scene, judge, publisher, service loop, command line."""
