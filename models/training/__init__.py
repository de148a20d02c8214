"""Making models: data sets, networks, recipes, evaluation, export. Needs the `train` extra."""
