"""Plans of poses: for a new recording, or to add to images taken already."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from jaxcal import InputError
from jaxcal.data.recording import MINIMUM_IMAGES
from jaxcal.design.candidates import Candidates
from jaxcal.design.criteria import check_criterion, curve, hypotheses, tre_weight, weight_of
from jaxcal.design.greedy import MOST_POSES, Cover, Rules, Search, choose, exchange, space_features
from jaxcal.design.information import (
    Known,
    Model,
    covariance_of,
    effective_elevational,
    known_information,
)
from jaxcal.design.names import Criterion
from jaxcal.design.noise import SD_RANGE_MM, Noise, check_result
from jaxcal.diagnostics.directions import direction_in_words
from jaxcal.diagnostics.uncertainty import mm_at_target, nearest_unknown
from jaxcal.result.calibration import Calibration
from jaxcal.runtime.array_types import Bool, Float
from jaxcal.runtime.arrays import outline
from jaxcal.runtime.given_values import check_flag, check_made, real_array, whole_number
from jaxcal.runtime.messages import enumerated

_SINGULAR = 1e-10
"""Eigenvalue ratio (scaled units, equal SDs) below which a direction is not determined."""
_TRIED_RAD, _TRIED_SHARE = 0.4, 0.6


@dataclass(frozen=True, eq=False)
class Plan:
    """Chosen poses and their predicted errors.

    Attributes:
        poses: (n, 4, 4) probe -> tracker, mm, in the order in which they were chosen.
        targets: (n, 3) where the target should be in the image at each pose, mm.
        filling: which of the poses fill space.
        rows: (n,) indices of the candidates from which they come.
        criterion: ``tre``, ``rp`` or ``d``.
        candidates: the candidates; their model has the SDs on which the predictions rest.
        known: the information before the plan.
        tre_mm: (n + 1,) predicted root mean square TRE over the region with 0, 1, ... n of the
            poses, mm.
        rp_mm: (n + 1,) predicted reconstruction precision with 0, 1, ... n of the poses, mm.
        rules: space filling and replicates.
    """

    poses: Float[np.ndarray, "n 4 4"]
    targets: Float[np.ndarray, "n 3"]
    filling: Bool[np.ndarray, " n"]
    rows: np.ndarray
    criterion: Criterion
    candidates: Candidates
    known: Known
    tre_mm: Float[np.ndarray, " n1"]
    rp_mm: Float[np.ndarray, " n1"]
    rules: Rules

    __repr__ = outline

    def __len__(self) -> int:
        return len(self.poses)

    def first(self, count: int) -> Plan:
        """The plan's first poses alone."""
        whole_number("count", count, 0, len(self))
        return replace(
            self,
            poses=self.poses[:count],
            targets=self.targets[:count],
            filling=self.filling[:count],
            rows=self.rows[:count],
            tre_mm=self.tre_mm[: count + 1],
            rp_mm=self.rp_mm[: count + 1],
        )

    @property
    def information(self) -> Float[np.ndarray, "p p"]:
        """Information with all poses of the plan."""
        return self.known.information + self.candidates.model.information(self.poses)

    @property
    def covariance(self) -> Float[np.ndarray, "p p"]:
        """Predicted covariance of X (v mm, omega rad), the target (mm) and unknown log scales."""
        return covariance_of(self.information)


def plan(
    candidates: Candidates,
    n: int,
    criterion: Criterion = "tre",
    prior: Known | Plan | Calibration | np.ndarray | None = None,
    *,
    polish: bool = True,
    swap: bool = True,
    cost_s: Float[np.ndarray, " m"] | None = None,
    rules: Rules | None = None,
) -> Plan:
    """The n poses that leave the smallest error.

    Args:
        candidates: to choose from.
        n: how many.
        criterion: ``tre``: target registration error over the region; ``rp``: reconstruction
            precision over poses like the candidates; ``d``: volume of the confidence ellipsoid.
        prior: what is known already: a calibration of the images ``candidates.taken`` (further
            poses then improve its weak directions), an earlier plan, information (p, p), or None.
        polish: move the poses off the candidates, along the gradient.
        swap: exchange poses after the greedy choice.
        cost_s: (m,) seconds that each candidate takes; the greedy choice then compares gains per
            second, and poses are not exchanged.
        rules: space filling and replicates.

    Returns:
        The poses in the order in which they were chosen, with the errors predicted after each.

    Raises:
        InputError: candidates that do not determine the unknowns (the message says what is
            missing), or a number of poses that is too small or too large.
    """
    check_criterion(criterion)
    check_flag("polish", polish)
    check_flag("swap", swap)
    known = known_before(prior, candidates)
    least = MINIMUM_IMAGES if known.images == 0 else 1
    whole_number("the number of poses", n, least, MOST_POSES)
    if cost_s is not None:
        cost_s = real_array(cost_s, "cost_s")
        if cost_s.shape != (len(candidates),) or not ((cost_s > 0) & np.isfinite(cost_s)).all():
            raise InputError("cost_s must have a positive number of seconds for each candidate")
    if isinstance(prior, Plan):
        candidates = _with_taken(candidates, prior)
    check_candidates(candidates)
    rules = Rules() if rules is None else rules
    check_made("rules", rules, Rules, "jaxcal.design.Rules")
    candidates = with_effective_noise(prior, candidates)
    search = make_search(candidates, known, criterion, rules)
    cover = None
    if rules.space_filling > 0:
        taken = replace(candidates, poses=candidates.taken_and_used)
        cover = Cover(space_features(candidates), space_features(taken))
    chosen = choose(search, n, cover, cost_s)
    if swap and cost_s is None:
        chosen = exchange(search, chosen)
    poses = candidates.poses[chosen.rows]
    if polish:
        from jaxcal.design.polish import polish as polished

        poses = polished(search, candidates, chosen)
    tre, rp = curve(candidates, known, poses)
    return Plan(
        poses=poses,
        targets=candidates.model.targets(poses),
        filling=np.array(chosen.filling, bool),
        rows=np.array(chosen.rows),
        criterion=criterion,
        candidates=candidates,
        known=known,
        tre_mm=tre,
        rp_mm=rp,
        rules=rules,
    )


def next_poses(
    result: Calibration | Plan | Known,
    candidates: Candidates,
    k: int = 1,
    criterion: Criterion = "tre",
    *,
    polish: bool = False,
    cost_s: Float[np.ndarray, " m"] | None = None,
    rules: Rules | None = None,
) -> Plan:
    """The k poses that would help most after a calibration; this takes milliseconds.

    Args:
        result: a calibration of the images ``candidates.taken``
            (:func:`jaxcal.design.candidates_around`), or a plan to go on with.
        candidates: to choose from.
        k: how many.
        criterion: see :func:`plan`.
        polish: see :func:`plan`.
        cost_s: see :func:`plan`.
        rules: see :func:`plan`; by default no pose fills space.

    Returns:
        A plan of k poses; ``tre_mm[0]`` is the error now, ``tre_mm[-1]`` that with all k poses.
    """
    rules = Rules(space_filling=0.0) if rules is None else rules
    return plan(
        candidates, k, criterion, result, polish=polish, swap=False, cost_s=cost_s, rules=rules
    )


def known_before(
    prior: Known | Plan | Calibration | np.ndarray | None, candidates: Candidates
) -> Known:
    """The information of a prior about the unknowns of the candidates' model."""
    check_made("candidates", candidates, Candidates, "make_candidates or candidates_around")
    size = candidates.model.size
    if prior is None:
        return Known(candidates.model.beliefs())
    if isinstance(prior, Known):
        return replace(prior, information=_checked_information(prior.information, size))
    if isinstance(prior, Plan):
        information = _checked_information(prior.information, size)
        return Known(information, prior.known.images + len(prior), prior.known.tuned)
    if isinstance(prior, np.ndarray):
        return Known(_checked_information(prior, size) + candidates.model.beliefs())
    check_result(prior)
    if candidates.taken is None:
        raise InputError(
            "the poses of the calibration's images are needed: "
            "make the candidates with candidates_around(recording, result), or give the images' "
            "poses as their 'taken'"
        )
    information = known_information(prior, candidates.model, candidates.taken)
    return Known(information, int(prior.images_used), bool(prior.sigma_tuned))


def _checked_information(value: object, size: int) -> Float[np.ndarray, "p p"]:
    """A caller's information about the unknowns of a model."""
    found = real_array(value, "information")
    if found.shape != (size, size) or not np.isfinite(found).all():
        raise InputError(
            f"information must be a finite {size} x {size} matrix, as the candidates' model has "
            f"{size} unknowns"
        )
    values = np.linalg.eigvalsh(found)
    if not np.allclose(found, found.T) or values[0] < -_SINGULAR * abs(values[-1]):
        raise InputError("information must be a symmetric matrix without negative eigenvalues")
    return found


def with_effective_noise(prior: object, candidates: Candidates) -> Candidates:
    """Candidates whose elevational SD is the calibration's effective one."""
    if not isinstance(prior, Calibration) or candidates.taken is None:
        return candidates
    model = candidates.model
    weight = tre_weight(candidates.constraints.region.grid(), candidates.model)
    factor = effective_elevational(prior, model, candidates.taken, weight)
    coefficients = np.array(model.noise.coefficients)
    coefficients[2, 0] += np.log(factor)
    return replace(
        candidates, model=replace(model, noise=replace(model.noise, coefficients=coefficients))
    )


def _with_taken(candidates: Candidates, before: Plan) -> Candidates:
    """Candidates after the images in use before a plan, and after its poses."""
    taken = np.concatenate([before.candidates.taken_and_used, before.poses])
    return replace(candidates, taken=taken, used=None)


def make_search(candidates: Candidates, known: Known, criterion: Criterion, rules: Rules) -> Search:
    """The input of greedy, exchange and polish."""
    model = candidates.model
    factors = hypotheses(model.noise.doubt)
    rows = model.jacobian(candidates.poses)
    before = np.repeat(known.information[None], len(factors), axis=0)
    taken = candidates.taken_and_used[: None if known.images > 0 else 0]
    x = model.image_to_probe[:3, :3]
    return Search(
        rows=rows[None] / factors[:, None, :, None],
        factors=factors,
        known=before,
        weight=weight_of(criterion, candidates),
        rules=rules,
        rotations=(candidates.poses[:, :3, :3] @ x).reshape(-1, 9),
        places=model.targets(candidates.poses),
        taken_rotations=(taken[:, :3, :3] @ x).reshape(-1, 9),
        taken_places=model.targets(taken),
    )


def check_candidates(candidates: Candidates) -> None:
    """Check that images at all candidates, with those taken, would determine the unknowns.

    Raises:
        InputError: they would not; the message has the direction and a kind of pose that helps.
    """
    model = replace(candidates.model, noise=Noise.constant((1.0, 1.0, 1.0)))
    every = np.concatenate([candidates.poses, candidates.taken_and_used])
    log_sd = candidates.model.noise.log_sigma(model.targets(candidates.poses))
    low, high = SD_RANGE_MM
    if log_sd.min() < np.log(low) or log_sd.max() > np.log(high):
        raise InputError(
            f"the noise model's SDs must be {low:g} to {high:g} mm at all candidate poses"
        )
    lever = np.sqrt(np.mean(np.sum(model.targets(every) ** 2, axis=1)))
    scale = mm_at_target(np.asarray(lever), model.blocks)
    found = model.information(every) / (scale[:, None] * scale)
    values, vectors = np.linalg.eigh(found)
    if values[0] > _SINGULAR * values[-1]:
        return
    null = values <= _SINGULAR * values[-1]
    weakest = direction_in_words(nearest_unknown(vectors[None], null[None])[0], model.blocks)
    raise InputError(
        f"images at all {len(candidates)} candidate poses would not determine {weakest}: "
        f"{_missing(candidates, model, vectors[:, null] / scale[:, None])}"
    )


def _missing(candidates: Candidates, model: Model, null: Float[np.ndarray, "p j"]) -> str:
    """Kinds of poses that would determine the directions that the candidates leave open."""
    bounds = candidates.constraints
    x, point = model.image_to_probe, model.point
    middle = np.median(candidates.numbers, axis=0)
    kinds = {
        "tilted about the image's lateral axis": (2, _TRIED_RAD),
        "tilted about its elevational axis": (3, _TRIED_RAD),
        "turned about its axial axis": (4, _TRIED_RAD),
        "with the target farther to the sides": (0, _TRIED_SHARE),
        "with the target nearer and farther": (1, _TRIED_SHARE),
    }
    noticed = {}
    for name, (axis, size) in kinds.items():
        numbers = np.repeat(middle[None], 2, axis=0)
        numbers[:, axis] += [size, -size]
        rows = model.jacobian(bounds.poses(numbers, x, point)).reshape(-1, model.size)
        noticed[name] = float(np.linalg.norm(rows @ null))
    most = max(noticed.values())
    named = [name for name, value in noticed.items() if value > 0.3 * most]
    return f"add poses {enumerated(named)}"
