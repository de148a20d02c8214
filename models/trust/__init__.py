"""Learning from outcomes, and the risk rule; without clock or I/O."""
