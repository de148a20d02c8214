"""Lessons of outcomes for a verdict, and the risk that is set; pure, without time and peers."""
