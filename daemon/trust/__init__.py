"""Learning from outcomes of lifts, and the risk: the allowed share of slips when `stable`."""
