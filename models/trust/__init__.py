"""Learning from outcomes, and the risk rule; pure functions without clock and peers."""
