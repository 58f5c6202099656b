"""Classical consolidation problems solved without finite elements: Mandel, Cryer, finite compression."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
from scipy.sparse import diags

from bayeskin.types import Array

EDGE_M = 10e-3  # edge of the bodies that consolidate


@dataclass(frozen=True)
class Mandel:
    """Mandel (1953): a slab 2a wide under rigid, frictionless plates, load 2F a length, drained at its sides.

    Constituents are incompressible (undrained Poisson's ratio 1/2, Skempton's coefficient 1), so that the
    pressure starts at F / 2a. Series as in Abousleiman et al., Geotechnique 46 (1996) 187, over the roots of
    tan(alpha) = (1 - nu) / (1/2 - nu) alpha; `tau` = c t / a^2.
    """

    shear: float
    nu: float
    stress: float  # F / a [Pa]

    @property
    def roots(self) -> Array:
        slope = (1 - self.nu) / (0.5 - self.nu)
        ends = [(k * np.pi + 1e-9, (k + 0.5) * np.pi - 1e-9) for k in range(400)]
        ends[0] = (0.3, 0.5 * np.pi - 1e-9)
        return np.array([brentq(lambda a: np.sin(a) - slope * a * np.cos(a), *pair) for pair in ends])

    def pressure(self, s: Array, tau: float) -> Array:
        """p [Pa] at s = distance from the middle over a, (n,)."""
        a = self.roots[:, None]
        weight = np.sin(a) / (a - np.sin(a) * np.cos(a)) * np.exp(-(a**2) * tau)
        return self.stress * (weight * (np.cos(a * s) - np.cos(a))).sum(0)

    def shortening(self, tau: float) -> float:
        """Strain normal to the plates, positive in compression; undrained at tau = 0."""
        a = self.roots
        weight = np.sin(a) * np.cos(a) / (a - np.sin(a) * np.cos(a)) * np.exp(-(a**2) * tau)
        return 0.5 * self.stress / self.shear * (1 - self.nu - weight.sum())


def cryer_centre(nu: float, tau: float) -> float:
    """Cryer (1963): pressure at the centre of a sphere over the pressure q on its drained surface.

    tau = c t / a^2. With incompressible constituents the dilatation obeys a diffusion equation, so its
    transform is B sinh(kr)/(kr), k^2 = s / c; p = M (dilatation - its surface value), M = lambda + 2 mu, and
    M div u - 4 mu u / a = -q / s on the surface give, with y = k a and G / M = (1 - 2 nu) / (2 (1 - nu)),

        p(0) = (q / s) (f - 1) / (f - 4 (G/M) g),   f = sinh(y) / y,   g = (y cosh(y) - sinh(y)) / y^3

    The inverse is Talbot's (Abate & Valko, Int. J. Numer. Meth. Engng 60, 2004, 979).
    """
    ratio, terms = (1 - 2 * nu) / (2 * (1 - nu)), 24

    def transform(s: complex) -> complex:
        y = np.sqrt(s)
        decayed = np.exp(-y)  # everything over cosh-like growth, lest it overflow
        f = 0.5 * (1 - decayed**2) / y
        g = (0.5 * y * (1 + decayed**2) - 0.5 * (1 - decayed**2)) / y**3
        return (f - decayed) / (f - 4 * ratio * g) / s

    theta = np.arange(1, terms) * np.pi / terms
    radius = 2 * terms / (5 * tau)
    s = radius * theta * (1 / np.tan(theta) + 1j)
    bend = 1 + 1j * (theta + (theta / np.tan(theta) - 1) / np.tan(theta))
    inner = np.real(np.exp(tau * s) * np.array([transform(v) for v in s]) * bend)
    return radius / terms * (0.5 * np.real(np.exp(radius * tau) * transform(radius + 0j)) + inner.sum())


def compression_stress(
    length: float,
    layers: tuple[tuple[float, float, float, float], ...],
    displacement: Callable[[float], float],
    rate: Callable[[float], float],
    times: Array,
    cells: int = 200,
    exponent: float = 0.0,
) -> Array:
    """Stress [Pa] at the drained end of a confined column whose drained end moves as given, (times,).

    layers : (thickness fraction, mu, lambda, mobility) from the closed to the drained end; the mobility at
        stretch l is its exp(exponent (l - 1))-fold

    In one dimension F = diag(l, 1, 1): the energy mu/2 (l^2 - 1 - 2 ln l) + lambda/2 (ln l)^2 gives the
    effective stress S(l) = mu (l - 1/l) + lambda ln(l) / l, equilibrium p = S(l) - P(t), and J C^-1 = 1/l:

        dl/dt = d/dX( (k / mu_f) / l dS/dX ) ,   no flux at X = 0,   flux = d'(t) at X = L, where p = 0

    The finite volumes are graded towards the drained end, two-point fluxes between centres; BDF in time.
    """
    s = np.linspace(0, 1, cells + 1)
    faces = length * np.sin(0.5 * np.pi * s)
    for fraction in np.cumsum([layer[0] for layer in layers])[:-1]:  # a face on each interface
        faces[np.abs(faces - fraction * length).argmin()] = fraction * length
    centres, widths = 0.5 * (faces[1:] + faces[:-1]), np.diff(faces)
    which = np.searchsorted(length * np.cumsum([layer[0] for layer in layers]), centres)
    mu, lam, mobility = (np.array([layer[i] for layer in layers])[which] for i in (1, 2, 3))

    def stress(stretch: Array) -> Array:
        return mu * (stretch - 1 / stretch) + lam * np.log(stretch) / stretch

    def resistance(stretch: Array) -> Array:
        return 0.5 * widths * stretch / (mobility * np.exp(exponent * (stretch - 1)))

    def velocity(t: float, stretch: Array) -> Array:
        half = resistance(stretch)
        flux = np.concatenate([[0.0], np.diff(stress(stretch)) / (half[1:] + half[:-1]), [rate(t)]])
        return np.diff(flux) / widths

    pattern = diags([np.ones(cells)] * 3, [-1, 0, 1], shape=(cells, cells))
    computed, start, now = [], 0.0, np.ones(cells)
    for end in times:  # each on its own, so that corners of the motion may be among them
        later = solve_ivp(velocity, (start, end), now, "BDF", rtol=1e-8, atol=1e-10, jac_sparsity=pattern)
        start, now = end, later.y[:, -1]
        assert abs((now - 1) @ widths - displacement(end)) < 1e-6 * length
        computed.append(stress(now)[-1] + rate(end) * resistance(now)[-1])
    return np.array(computed)
