"""Everything that touches a sensor: wire formats, transports, the replay driver, the twins."""
