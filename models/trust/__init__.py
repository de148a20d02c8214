"""What outcomes teach about a verdict, and the risk that is set; pure, without time and peers."""
