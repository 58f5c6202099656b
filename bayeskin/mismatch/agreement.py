"""Measures how well several recordings of one skin agree: what each of them loses by sharing the skin.

The chosen set is fitted to each recording alone. If the recordings show the same skin with the same
mechanisms, twice the gain in log-likelihood over the joint fit has a chi-squared distribution with at most as
many degrees of freedom as there are shared parameters (Raveri & Hu 2019, Phys. Rev. D 99:043506, where it is
called the goodness-of-fit loss). Its probability is stated as the distance from zero of a standard normal.

What each recording says about the skin follows from the expected information near the joint fit. It adds up
over recordings, after the values that each recording has for itself have been marginalised.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2, norm

from bayeskin.forward.interface import ModelRun
from bayeskin.inference import LogPosterior
from bayeskin.inference.gauss_newton import gauss_newton
from bayeskin.inference.problem import UNIFORM_PRECISION
from bayeskin.mismatch.context import DiagnosisContext
from bayeskin.mismatch.evidence import evidence
from bayeskin.mismatch.search_context import for_task
from bayeskin.mismatch.tasks import AnswerTasks, FitTask
from bayeskin.mismatch.trust_region import SetFit
from bayeskin.types import Array
from bayeskin.types.joint import plain_name, recording_of, values_in

RUNS = 6  # largest number of model runs of a fit to one recording
CONTRADICTS = 3.0  # distance [sd] from which a recording contradicts the others


@dataclass(frozen=True)
class Agreement:
    """The agreement of one recording with the others.

    rms_n : RMS residual [N] of the joint fit in this recording; noise_n : sd [N] of the noise of its bins
    tension : distance [sd] of the loss from zero; None where the recording could not be fitted alone
    sd_alone : sd of each shared parameter of the skin by this recording alone, as a share of the prior's sd
    widens : factor by which the sd of each of these parameters would be larger without this recording
    """

    name: str
    rms_n: float
    noise_n: float
    tension: float | None
    sd_alone: Mapping[str, float]
    widens: Mapping[str, float]

    @property
    def contradicts(self) -> bool:
        """Returns whether the recording contradicts the others."""
        return self.tension is not None and self.tension > CONTRADICTS


def agreements(ask: AnswerTasks, context: DiagnosisContext, joint: SetFit) -> list[Agreement]:
    """Returns the agreement of each of several recordings with a joint fit of a set; [] for one recording."""
    if not context.binned.spans:
        return []
    names, binned = joint.fit.names, context.binned
    tasks = [
        FitTask(
            names, values_in(joint.fit.theta, number), RUNS, for_task(joint.correction_n[bins]), None, number
        )
        for number, bins in enumerate(binned.slices)
    ]
    rows, said = [], _said_about_skin(context, joint)
    for number, (answer, bins) in enumerate(zip(ask(tasks), binned.slices, strict=True)):
        residual_n = (binned.force_n - joint.fit.force_n)[bins]
        noise_n = float(np.sqrt(np.nanmean(binned.variance_n2[bins])))
        tension = None if not isinstance(answer, SetFit) else _tension(context, joint, answer, number)
        rms_n = float(np.sqrt(np.nanmean(residual_n**2)))
        rows.append(Agreement(binned.spans[number].name, rms_n, noise_n, tension, *said[number]))
    return rows


def _tension(context: DiagnosisContext, joint: SetFit, alone: SetFit, number: int) -> float:
    """Returns the distance [sd] of what a recording loses by the joint fit, compared with its fit alone."""
    posterior, vector = _at_joint_fit(context, joint, number)
    theta = posterior.from_sampling(vector)
    loss = 2.0 * float(alone.fit.log_likelihood - posterior.log_likelihood(theta)[0])
    shared = len(_shared_names(context, joint))
    return float(norm.isf(max(chi2.sf(max(loss, 0.0), shared), 1e-300)))


def _at_joint_fit(context: DiagnosisContext, joint: SetFit, number: int) -> tuple[LogPosterior, Array]:
    """Returns the posterior of one recording alone near the joint fit, and the point (D,) of this fit."""
    own, bins = context.alone[number], context.binned.slices[number]
    names = context.space(joint.fit.names).names
    columns = sorted(values_in({name: j for j, name in enumerate(names)}, number).values())
    assert joint.run.slopes_n is not None
    run = ModelRun(joint.run.theta[columns], joint.run.force_n[bins], joint.run.slopes_n[bins][:, columns])
    correction_n = joint.correction_n[bins]
    posterior = own.posterior(joint.fit.names, [run], correction_n if correction_n.any() else None)
    vector = posterior.vector(values_in(joint.fit.theta, number))
    return posterior, np.clip(vector, *posterior.bounds)


def _shared_names(context: DiagnosisContext, joint: SetFit) -> list[str]:
    """Returns the names of the skin's parameters that all recordings share."""
    names = context.space(joint.fit.names).names
    own = {plain_name(name) for name in names if recording_of(name)}
    return [name for name in names if plain_name(name) == name and name not in own]


def _said_about_skin(
    context: DiagnosisContext, joint: SetFit
) -> list[tuple[dict[str, float], dict[str, float]]]:
    """Returns `Agreement.sd_alone` and `Agreement.widens` of each recording.

    All sds are in coordinates in which the prior is uniform from 0 to 1.
    """
    names, information = _shared_names(context, joint), list[Array]()
    prior = UNIFORM_PRECISION * np.eye(len(names))
    for number in range(len(context.alone)):
        posterior, vector = _at_joint_fit(context, joint, number)
        covariance = evidence(posterior, gauss_newton(posterior, vector, None, 0))[1]
        columns = [posterior.names.index(name) for name in names]
        values, modes = np.linalg.eigh(np.linalg.inv(covariance[np.ix_(columns, columns)]) - prior)
        information.append((modes * np.maximum(values, 0.0)) @ modes.T)

    def sd(parts: Sequence[Array]) -> Array:
        """Returns the sds (d,) by the information of some recordings, as shares of the prior's sd."""
        covariance = np.linalg.inv(prior + np.sum(parts, axis=0))
        return np.asarray(np.sqrt(UNIFORM_PRECISION * np.diag(covariance)))

    by_all, said = sd(information), []
    for number, own in enumerate(information):
        without = sd([*information[:number], *information[number + 1 :]])
        alone = dict(zip(names, map(float, sd([own])), strict=True))
        said.append((alone, dict(zip(names, map(float, without / by_all), strict=True))))
    return said
