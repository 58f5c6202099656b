"""Effects that were not in the catalogue of mechanisms when the sets were made, simulated by the full model.

They serve the proof only. Some of them have entered the catalogue since: Poisson's ratios, moduli that change
evenly or within a minute, breathing, a bent load cell, a slow amplifier and, in another form, a plastic set.

Each effect has one strength, drawn log-uniformly between two bounds. An effect changes constants or layers of
the skin, the arm, the solid's law over time or strain, the motion that the skin sees, or the force.
"""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.signal import lfilter

from bayeskin.finite_element.assembly import inverse_and_determinant
from bayeskin.finite_element.kernels import linearise_kernel, respond_kernel
from bayeskin.finite_element.problem import Constants, Material, Sites, material
from bayeskin.finite_element.tissue import Bind, TissueLaw
from bayeskin.geometry import Geometry
from bayeskin.mechanisms.elastic import elastic_stress, scale_elastic
from bayeskin.mechanisms.mechanism import ForceOfTime
from bayeskin.mechanisms.stiffness_drift import Piece, drifting
from bayeskin.proof.protocol import MOTION
from bayeskin.types import Array, PadMotion

END_S = float(MOTION.time_s[-1])
LOWEST_LAYER = 0.5  # share of the subcutis' thickness


def _as_it_is(value: Any) -> Any:
    return value


@dataclass(frozen=True)
class Change:
    """The changes with which the full model is run.

    constants, geometry : replace those of the base model
    deep : factor on the moduli of the subcutis' lower half
    laws : tissue laws that are added
    moved : returns the motion that the skin sees, from the protocol
    reported : returns the force that is reported, from the force of the skin
    """

    constants: Constants = Constants()  # noqa: RUF009 - frozen
    geometry: Geometry = Geometry()
    deep: float = 1.0
    laws: tuple[Bind, ...] = ()
    moved: Callable[[PadMotion], PadMotion] = _as_it_is
    reported: Callable[[ForceOfTime], ForceOfTime] = _as_it_is

    @property
    def of_force_alone(self) -> bool:
        """Returns whether only the reported force changes, so that the full model runs unchanged."""
        return replace(self, reported=_as_it_is) == Change()

    def solid(self, base: Material, depth: Array) -> Material:
        """Returns the changed constants of the cells (e,).

        depth (e,) : height of each cell's middle above the bottom, as a share of the subcutis' thickness
        """
        factor = np.where(depth < LOWEST_LAYER, self.deep, 1.0)
        return replace(base, mu=factor * base.mu, lam=factor * base.lam)


@dataclass(frozen=True)
class Outside:
    """One effect: its description, the bounds of its strength, and the change for a given strength."""

    sentence: str
    strengths: tuple[float, float]
    change: Callable[[float], Change]


@respond_kernel
def softened(
    time_s, elapsed_s, par, data, deformation, pressure, gradient, before, after, stress, content, flux
):  # fmt: skip
    """Divides the elastic part of the stress by 1 + a (tr C - 3). `par` holds the loss a."""
    inverse, elastic = np.empty((3, 3)), np.empty((3, 3))
    for n in range(len(pressure)):
        f = deformation[n]
        elastic_stress(f, pressure[n], stress[n], inverse, elastic)
        left = 1.0 / (1.0 + par[0] * max((f * f).sum() - 3.0, 0.0))
        for i in range(3):
            for k in range(3):
                stress[n, i, k] += (left - 1.0) * elastic[i, k]


@linearise_kernel
def softened_derivatives(
    time_s, elapsed_s, par, data, deformation, pressure, gradient,
    before, stress_f, stress_p, content_f, content_p, flux_f, flux_g,
):  # fmt: skip
    """Changes the derivative to dP = (1 / b) dP_e - (2 a / b^2) (P_e (x) F) : dF.

    Here b = 1 + a (tr C - 3). `data` holds mu and lambda.
    """
    loss, inverse = par[0], np.empty((3, 3))
    for point in range(len(pressure)):
        f, mu, lam = deformation[point], data[point, 0], data[point, 1]
        j = inverse_and_determinant(f, inverse)
        strain = (f * f).sum() - 3.0
        left = 1.0 / (1.0 + loss * max(strain, 0.0))
        scale_elastic(left, pressure[point], j, inverse, stress_f[point])
        if strain <= 0.0:
            continue
        spherical = lam * np.log(j) - mu
        for i in range(3):
            for k in range(3):
                own = mu * f[i, k] + spherical * inverse[k, i]
                for m in range(3):
                    for n in range(3):
                        stress_f[point, 3 * i + k, 3 * m + n] -= 2.0 * loss * left**2 * own * f[m, n]


def ageing(pieces: Sequence[Piece]) -> Change:
    """Returns a change: the moduli follow a factor of time, given in pieces (`stiffness_drift`)."""

    def bind(values: Mapping[str, float], sites: Sites) -> TissueLaw:
        return drifting(sites, pieces)

    return Change(laws=(bind,))


def softening(loss: float) -> Change:
    """Returns a change: the solid loses stiffness the further it is stretched. `loss` is a [-]."""

    def bind(values: Mapping[str, float], sites: Sites) -> TissueLaw:
        solid = material(values, sites.cutis)
        return TissueLaw(
            par=np.array([loss]),
            data=sites.table(solid.mu, solid.lam),
            respond=softened,
            linearise=softened_derivatives,
        )

    return Change(laws=(bind,))


SETTING_S, LOOSENING_S = 15.0, 3.0  # time constants of a tissue that loosens while it moves


def thixotropy(loss: float) -> Change:
    """Returns a change: the moduli lose a share that grows while the drive moves and vanishes at rest."""
    moving = np.diff(MOTION.displacement_m) != 0.0
    loose, pieces = 0.0, []
    for moves, start_s, lasts_s in zip(moving, MOTION.time_s[:-1], np.diff(MOTION.time_s), strict=True):
        end, tau = (1.0, LOOSENING_S) if moves else (0.0, SETTING_S)
        pieces.append((float(start_s), 1.0 - loss * loose, -loss * (end - loose) / tau, tau))
        loose = end + (loose - end) * float(np.exp(-lasts_s / tau))
    return ageing(pieces)


YIELD_M = 4e-3


def plastic_set(share: float) -> Change:
    """Returns a change: the skin keeps a share of the farthest displacement beyond a yield point.

    The kept share does not return.
    """

    def moved(motion: PadMotion) -> PadMotion:
        first = int(np.argmax(motion.displacement_m > YIELD_M))
        start, end = motion.displacement_m[first - 1 : first + 1]
        yields_s = np.interp(YIELD_M, [start, end], motion.time_s[first - 1 : first + 1])
        time_s = np.insert(motion.time_s, first, yields_s)
        u = motion.at(time_s)
        return PadMotion(time_s, u - share * np.maximum(np.maximum.accumulate(u) - YIELD_M, 0.0))

    return Change(moved=moved)


def peeling(share: float) -> Change:
    """Returns a change: from the third cycle on, the pads' edges have come off.

    The displacement that the skin sees is then smaller by a share.
    """
    third = int(np.flatnonzero(np.diff(np.sign(np.diff(MOTION.displacement_m))) > 1)[1]) + 1

    def moved(motion: PadMotion) -> PadMotion:
        late = np.arange(len(motion.time_s)) > third
        return PadMotion(motion.time_s, motion.displacement_m * np.where(late, 1.0 - share, 1.0))

    return Change(moved=moved)


def scaled(factor: Callable[[Array, Array], Array]) -> Change:
    """Returns a change: the force is multiplied by a factor of time and force."""

    def reported(force: ForceOfTime) -> ForceOfTime:
        return lambda time_s: force(time_s) * factor(np.asarray(time_s), force(time_s))

    return Change(reported=reported)


BREATH_S = 4.1
TWITCHES_S, TWITCH_S = (120.0, 240.0), 4.0


def twitching(size_n: float) -> Change:
    """Returns a change: the muscle below the skin pulls twice, for some seconds each."""

    def pull(time_s: Array) -> Array:
        return size_n * np.sum([np.exp(-0.5 * ((time_s - at) / TWITCH_S) ** 2) for at in TWITCHES_S], axis=0)

    return Change(reported=lambda force: lambda time_s: force(time_s) + pull(np.asarray(time_s)))


GRID_S = 0.01


def slow_amplifier(time_constant_s: float) -> Change:
    """Returns a change: the force passes a first-order low-pass filter."""
    grid = np.arange(0.0, END_S + GRID_S, GRID_S)
    keep = float(np.exp(-GRID_S / time_constant_s))

    def reported(force: ForceOfTime) -> ForceOfTime:
        late = lfilter([1.0 - keep], [1.0, -keep], force(grid)[0])
        return lambda time_s: np.atleast_2d(np.interp(time_s, grid, late))

    return Change(reported=reported)


def _of(**changed: Any) -> Change:
    return Change(constants=Constants(**changed))


FATIGUE_S = 60.0


def _as_thick(cutis_m: float) -> Change:
    """Returns a change: the cutis has another thickness [m].

    Both layers together stay as thick as the article's.
    """
    return Change(geometry=Geometry(cutis_m=cutis_m, subcutis_m=Geometry().thickness_m - cutis_m))


def _on_an_arm(radius_m: float) -> Change:
    return Change(geometry=Geometry(arm_radius_m=radius_m))


OUTSIDE: dict[str, Outside] = {
    "poisson-cutis": Outside("Poisson's ratio of the cutis", (0.2, 0.4), lambda s: _of(nu_c=s)),
    "poisson-subcutis-high": Outside("Poisson's ratio of the subcutis", (0.4, 0.48), lambda s: _of(nu_s=s)),
    "poisson-subcutis-low": Outside("Poisson's ratio of the subcutis", (0.01, 0.15), lambda s: _of(nu_s=s)),
    "thin-cutis": Outside("thickness of the cutis [m]", (1e-3, 1.6e-3), _as_thick),
    "thick-cutis": Outside("thickness of the cutis [m]", (2.5e-3, 4e-3), _as_thick),
    "thin-arm": Outside("radius below the subcutis [m]", (0.03, 0.042), _on_an_arm),
    "thick-arm": Outside("radius below the subcutis [m]", (0.058, 0.09), _on_an_arm),
    "muscle": Outside("factor by which a third layer is stiffer", (4.0, 40.0), lambda s: Change(deep=s)),
    "soft-fat": Outside("factor of the moduli of a third layer", (0.03, 0.3), lambda s: Change(deep=s)),
    "hardening": Outside(
        "share by which the moduli grow evenly in all", (0.03, 0.4),
        lambda s: ageing([(0.0, 1.0, s / END_S, np.inf)]),
    ),
    "fatigue": Outside(
        "share by which the moduli fall, most of it within a minute", (0.03, 0.4),
        lambda s: ageing([(0.0, 1.0, -s / FATIGUE_S, FATIGUE_S)]),
    ),
    "thixotropy": Outside("share that the moduli lose while the skin is moved", (0.03, 0.4), thixotropy),
    "strain-softening": Outside("loss of stiffness by tr C - 3", (0.3, 10.0), softening),
    "plastic-set": Outside("share of the farthest displacement that is kept", (0.01, 0.1), plastic_set),
    "peeling": Outside("share of the displacement that is lost from cycle 3 on", (0.01, 0.1), peeling),
    "breathing": Outside(
        "share of the force that comes and goes in 4.1 s", (0.01, 0.2),
        lambda s: scaled(lambda t, f: 1.0 + s * np.sin(2.0 * np.pi * t / BREATH_S)),
    ),
    "bent-cell": Outside(
        "share that the cell reads too much at 1 N", (0.05, 0.6), lambda s: scaled(lambda t, f: 1.0 + s * f)
    ),
    "twitches": Outside("height of two pulls of the muscle [N]", (5e-3, 0.1), twitching),
    "slow-amplifier": Outside("time constant of the amplifier [s]", (0.3, 5.0), slow_amplifier),
}  # fmt: skip
