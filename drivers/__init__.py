"""Sensors: wire formats, transports, drivers of devices and recordings, twins."""
