"""Which effect a model of a table lacks: tolerances, unexplained response and selection by evidence."""
