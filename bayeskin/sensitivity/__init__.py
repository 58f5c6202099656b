"""Computes the global sensitivity of the force history: Sobol' indices and Shapley effects."""
