"""A forward model of somebody's own: text of a file, and a UM-Bridge server by the package `umbridge`."""

from __future__ import annotations

import sys

import numpy as np
import umbridge

SPRING = '''
"""A spring and a Maxwell element in parallel."""
import numpy as np

def force(theta, time_s, displacement_m):
    pull = theta["stiffness"] * displacement_m
    rate = np.diff(displacement_m) / np.diff(time_s)
    element = np.zeros(len(time_s))
    decay = np.exp(-np.diff(time_s) / theta["tau"])
    for i in range(1, len(time_s)):
        element[i] = element[i - 1] * decay[i - 1] + rate[i - 1] * theta["tau"] * (1 - decay[i - 1])
    return pull + theta["share"] * theta["stiffness"] * element

def raising(theta, time_s, displacement_m):
    return 1 / 0

def short(theta, time_s, displacement_m):
    return displacement_m[:3]

def endless(theta, time_s, displacement_m):
    return displacement_m + np.inf

number = 3
'''
TRUE = {"stiffness": 100.0, "share": 0.6, "tau": 8.0}
PARAMETERS = """
[parameters.stiffness]
lower = 10.0
upper = 1000.0
prior = "log-uniform"
unit = "N/m"
[parameters.share]
lower = 0.0
upper = 1.0
[parameters.tau]
lower = 1.0
upper = 50.0
prior = "log-uniform"
unit = "s"
"""


def spring() -> object:
    """The function of `SPRING`."""
    namespace: dict[str, object] = {}
    exec(SPRING, namespace)
    return namespace["force"]


class Served(umbridge.Model):
    """The spring behind UM-Bridge, its parameters in two vectors."""

    def get_input_sizes(self, config):
        return [1, 2]

    def get_output_sizes(self, config):
        return [len(config["times_s"])]

    def __call__(self, parameters, config):
        (stiffness,), (share, tau) = parameters
        if stiffness > 900.0:
            raise ValueError("too stiff")
        time_s = np.array(config["times_s"])
        displacement_m = np.interp(time_s, config["protocol"]["time_s"], config["protocol"]["displacement_m"])
        theta = {"stiffness": stiffness, "share": share, "tau": tau}
        return [spring()(theta, time_s, displacement_m).tolist()]

    def supports_evaluate(self):
        return True


if __name__ == "__main__":
    umbridge.serve_models([Served("spring"), Served("other")], port=int(sys.argv[1]))
