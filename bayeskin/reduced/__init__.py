"""The reduced-order model of the test: the full model projected on few modes and integrated at few points."""
