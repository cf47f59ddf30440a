"""Report of `avis gap` (disagreement of simulation and measurement), one module per section."""
