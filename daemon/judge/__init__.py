"""The functional core: readings in, verdicts out; no socket, no file, no clock of its own."""
