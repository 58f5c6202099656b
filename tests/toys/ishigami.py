"""Ishigami's function with its Sobol' indices in closed form."""

import numpy as np

from bayeskin.types import Parameter, ParameterSpace

ONE_BIN = np.array([0.0, 1.0])


def box(dim, lower, upper):
    return ParameterSpace(tuple(Parameter(f"x{i}", "", lower, upper, "uniform") for i in range(dim)))


def ishigami(x):
    return (np.sin(x[:, 0]) + 7 * np.sin(x[:, 1]) ** 2 + 0.1 * x[:, 2] ** 4 * np.sin(x[:, 0]))[:, None]


def ishigami_indices():
    first, second, both = 0.5 * (1 + 0.1 * np.pi**4 / 5) ** 2, 49 / 8, 8 * 0.01 * np.pi**8 / 225
    whole = first + second + both
    return np.array([first, second, 0]) / whole, np.array([first + both, second, both]) / whole
