"""How far a verdict can be trusted: it learns from outcomes, and keeps a risk that is set."""
