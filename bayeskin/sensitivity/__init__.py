"""Global sensitivity of the force history: Sobol' indices and Shapley effects."""
