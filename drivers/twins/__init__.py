"""Stand-ins for hardware and grasps that tests and demonstrations use, never the daemon."""
