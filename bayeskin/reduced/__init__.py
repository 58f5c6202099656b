"""The reduced-order model of the test: the full model projected on few modes, integrated at few points."""
