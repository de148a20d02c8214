"""Parts that tests of several rooms use: a loop on a stepped clock, scenes, and waiting."""
