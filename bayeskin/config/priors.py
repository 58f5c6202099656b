"""The priors of a run's parameters: the default priors with the changes of a configuration."""

from __future__ import annotations

from dataclasses import replace

from bayeskin.config.configuration import Config
from bayeskin.config.device import ROOM, length_parameters
from bayeskin.config.run_sections import PriorConfig
from bayeskin.config.sections import one_of
from bayeskin.design import default_space
from bayeskin.errors import InputError
from bayeskin.geometry import LENGTHS, Geometry, moved
from bayeskin.types import Correlation, Parameter, ParameterSpace
from bayeskin.types.joint import own_name


def parameter_space(config: Config, where: object = "configuration") -> ParameterSpace:
    """Returns the prior of a configuration: the default parameters with the configuration's changes.

    With a forward model of the user's own, these are the parameters of the configuration. Uncertain lengths
    of the tissue follow after the default parameters. Raises InputError for an unknown parameter, a lower
    bound above the upper, a logarithmic prior that reaches zero, impossible lengths, or impossible
    correlations.
    """
    space = (
        _space_of_forward_model(config, where)
        if config.model.forward is not None
        else _space_of_full_model(config, where)
    )
    correlations = tuple(
        Correlation(name, partner, value)
        for name, prior in config.parameters.items()
        for partner, value in prior.correlations.items()
    )
    space = ParameterSpace((*space.parameters, *_further_initial_pressures(config, space)))
    try:
        return replace(space, correlations=correlations)
    except InputError as error:
        raise InputError(f"{where}: {error.where}", error.problem, error.remedy) from None


def _further_initial_pressures(config: Config, space: ParameterSpace) -> list[Parameter]:
    """Returns the initial pressure of each recording after the first, with the prior of the first."""
    pressures = [p for p in space.parameters if p.name == "p_init" and p.name not in config.fit.shared]
    return [
        replace(p, name=own_name(p.name, number), description=f"{p.description}, in recording {number + 1}")
        for number in range(1, len(config.each_recording))
        for p in pressures
    ]


def _space_of_full_model(config: Config, where: object) -> ParameterSpace:
    """Returns the default parameters and the uncertain lengths, with the configuration's changes."""
    stated = config.geometry(where)
    default = ParameterSpace((*default_space().parameters, *length_parameters(stated)))
    unknown = sorted(set(config.parameters) - set(default.names))
    if unknown:
        where = f"{where}: parameters.{unknown[0]}"
        raise InputError(where, "this parameter is not known", f"use {one_of(default.names)}")
    space = ParameterSpace(
        tuple(_overridden(p, config.parameters.get(p.name), where) for p in default.parameters)
    )
    _check_lengths(space, stated.geometry, where)
    return space


def _check_lengths(space: ParameterSpace, geometry: Geometry, where: object) -> None:
    """Raises InputError where some lengths between the bounds cannot be meshed."""
    lengths = [p for p in space.parameters if p.name in LENGTHS]
    low = {p.name: p.lower / (1.0 + ROOM) for p in lengths}
    high = {p.name: p.upper / (1.0 - ROOM) for p in lengths}
    thickest = {name: low[name] if name == "arm_radius_m" else value for name, value in high.items()}
    for corner in (low, high, thickest):
        try:
            moved(geometry, corner)
        except InputError as error:
            p = next((p for p in lengths if p.name == error.where), lengths[0])
            problem = f"its prior reaches from {1e3 * p.lower:g} to {1e3 * p.upper:g} mm, too far"
            raise InputError(f"{where}: parameters.{p.name}", problem, error.remedy) from None


def _space_of_forward_model(config: Config, where: object) -> ParameterSpace:
    """Returns the parameters of a forward model of the user's own, by default those of the full model.

    The parameters do not have the law by which the force of the full model scales with stiffness and
    permeability.
    """
    if not config.parameters:
        return ParameterSpace(tuple(replace(p, stress_power=0) for p in default_space().parameters))
    parameters = []
    for name, prior in config.parameters.items():
        for key in ("lower", "upper"):
            if getattr(prior, key) is None:
                at = f"{where}: parameters.{name}.{key}"
                raise InputError(
                    at, "there is no value", "a forward model of your own needs both bounds of each parameter"
                )
        blank = Parameter(name, prior.unit or "", 0.0, 0.0, "uniform")
        parameters.append(_overridden(blank, prior, where))
    return ParameterSpace(tuple(parameters))


def _overridden(default: Parameter, change: PriorConfig | None, where: object) -> Parameter:
    """Returns a parameter with the changes of a configuration. Raises InputError for invalid changes."""
    if change is None:
        return default
    if change.unit not in (None, default.unit):
        raise InputError(
            f"{where}: parameters.{default.name}.unit",
            f"{change.unit!r} is not the unit of this parameter",
            f"it must be {default.unit!r}",
        )
    lower = default.lower if change.lower is None else change.lower
    upper = default.upper if change.upper is None else change.upper
    prior = change.prior or default.prior
    at = f"{where}: parameters.{default.name}"
    if not lower < upper:
        raise InputError(
            at,
            f"the lower bound {lower:g} is not below the upper bound {upper:g} {default.unit}",
            "change one of them",
        )
    if prior.startswith("log") and lower <= 0:
        raise InputError(
            f"{at}.lower", f"a {prior} prior cannot begin at {lower:g}", "the bound must be above zero"
        )
    centre, spread = change.centre_and_spread if change.prior else (default.centre, default.spread)
    if prior.endswith("normal") and not lower <= centre <= upper:
        raise InputError(
            at,
            f"the prior is centred at {centre:g} {default.unit}",
            f"the centre must lie within the bounds, {lower:g} to {upper:g}",
        )
    return replace(
        default, lower=lower, upper=upper, prior=prior, source=change.source, centre=centre, spread=spread
    )
