"""Pivot calibration: the tip of a tracked tool from poses taken while it turns about its tip.

This is the degenerate case of Eq. 7: B_i p = c for all i, with p the tip in the tool's frame and c
the pivot point. In this calibration every measurement is (0, 0), so p is the translation of X, and
X's rotation is held fixed: the free blocks are X's translation and the point. Solver, consensus,
covariance and observability are the same as for image calibration.

The errors of the three axes share one SD, so this is plain least squares on the images that agree.

A tracker delivers tens of poses a second, and the tip slides in its dimple more slowly. So errors
are alike for t successive poses (:func:`jaxcal.calibration.dependence.alike_for`), and n poses are
worth n / t independent ones: the covariance is t times as large.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxcal import InputError
from jaxcal.calibration.answer import inverse_and_observability
from jaxcal.calibration.dependence import alike_for
from jaxcal.data.poses import check_poses
from jaxcal.data.problem import Problem
from jaxcal.data.recording import LEAST_REACH_MM, MINIMUM_IMAGES, MetresError
from jaxcal.diagnostics.outliers import listed_outliers, outliers
from jaxcal.diagnostics.uncertainty import LARGEST_SD, Spectra
from jaxcal.model.outlying import stands_out
from jaxcal.model.parameters import Parameters, retract
from jaxcal.model.residuals import target_in_image
from jaxcal.model.thresholds import FEWEST_TO_LEAVE_OUT
from jaxcal.result.calibration import Status, check_one, status_names
from jaxcal.runtime import compiler, executables
from jaxcal.runtime.array_types import AnyArray
from jaxcal.runtime.arrays import first_images, is_traced
from jaxcal.runtime.given_values import check_flag, real_array, truth_array
from jaxcal.runtime.jax_modes import in_own_modes, inside_transformation, require_float64
from jaxcal.runtime.messages import counted
from jaxcal.runtime.one_or_batch import OneOrBatch
from jaxcal.solvers import dense
from jaxcal.solvers.consensus import ConsensusModel, find_consensus, linearise, studentised_errors
from jaxcal.solvers.proposals import subset_systems

BLOCKS = ("translation", "point")
AXES = ("x", "y", "z")
"""Axes of the tool's frame, along which the components of an error are."""
_SUBSET = 4
"""Poses in a proposal's subset."""
_LARGEST_RMS_MM = 5.0
"""A tip that stays in a dimple does not move by so much."""
_LARGEST_SD_MM = 1.0
"""A tip known less well serves no calibration; a tool that is hardly turned has such a one."""


class Pivot(OneOrBatch, eqx.Module):
    """A pivot calibration (or a batch, with leading axes).

    Attributes:
        tip: p in the tool's frame, mm.
        point: c in the tracker's frame, mm.
        covariance: of (tip, point), mm^2; NaN where the poses do not determine them, or the solve
            failed.
        sigma: SD of the error along one axis, mm.
        rms: root mean square length of the errors B_i p - c over the used poses, mm.
        residual: those errors in the tool's frame, mm; 0 where not used.
        mask: 1 for used poses.
        outlier: 1 where a pose does not fit the rest; a robust solve leaves it out.
        studentised_errors: errors of all poses, in robust SDs of the used poses' errors.
        status_code: a :class:`jaxcal.Status`.
        information: of (tip, point) for errors with an SD of 1 mm, each of which counts once.
        alike_for: errors are alike for so many successive poses, of which covariance and
            information count one; 1 for batches and under transformations, where it is not looked
            for.
        robust: poses that do not fit the rest were left out (static).
    """

    tip: Float[Array, "*batch 3"]
    point: Float[Array, "*batch 3"]
    covariance: Float[Array, "*batch 6 6"]
    sigma: Float[Array, "*batch"]
    rms: Float[Array, "*batch"]
    residual: Float[Array, "*batch n 3"]
    mask: Float[Array, "*batch n"]
    outlier: Float[Array, "*batch n"]
    studentised_errors: Float[Array, "*batch n 3"]
    status_code: Int[Array, "*batch"]
    information: Float[Array, "*batch 6 6"]
    alike_for: Float[Array, "*batch"]
    robust: bool = eqx.field(static=True, default=True)

    @property
    def converged(self) -> Bool[Array, "*batch"]:
        """Whether tip and point are determined (traceable)."""
        return jnp.asarray(self.status_code == Status.CONVERGED)

    @property
    def status(self) -> str | np.ndarray:
        """converged, unobservable or failed; an array of these for a batch."""
        return status_names(np.asarray(self.status_code))

    @property
    def weakest(self) -> Float[np.ndarray, "*batch 3"]:
        """Unit vector of the tip's least determined direction, in the tool's frame (concrete)."""
        weakest = self._weakest()[0][..., :3]
        length = np.linalg.norm(weakest, axis=-1, keepdims=True)
        return weakest / np.maximum(length, 1e-30)

    @property
    def weakest_sd(self) -> Float[np.ndarray, "*batch"]:
        """SD along the least determined direction of tip and point, mm; NaN if it is not finite."""
        return self._weakest()[1]

    def _weakest(self) -> tuple[np.ndarray, np.ndarray]:
        information, sigma = np.asarray(self.information), np.asarray(self.sigma)
        flat = information.reshape(-1, 6, 6)
        found = Spectra.of(flat, flat, sigma.reshape(-1) ** 2, float(np.finfo(flat.dtype).eps))
        return found.weakest.reshape(*sigma.shape, 6), found.weakest_sd.reshape(sigma.shape)

    @property
    def wrong_frames(self) -> str | None:
        """That no tip stays in place under these poses, in words, or None (one, concrete).

        Raises:
            InputError: of a batch.
        """
        check_one(self.status_code)
        if self.status == "failed" or not float(self.rms) > _LARGEST_RMS_MM:
            return None
        return (
            f"errors of {float(self.rms):.1f} mm are too large for a tip that stays in place: "
            "either it slipped in most poses, or the poses are wrong (order or signs of their "
            "numbers, units, direction)"
        )

    @property
    def uncertain(self) -> bool:
        """Whether the tip's SD exceeds 1 mm along some direction (one, concrete).

        Raises:
            InputError: of a batch.
        """
        check_one(self.status_code)
        return self._largest_sd()[0] > _LARGEST_SD_MM

    def _largest_sd(self) -> tuple[float, np.ndarray]:
        """The tip's largest SD, mm, and its direction in the tool's frame; 0 if it is unknown."""
        covariance = np.asarray(self.covariance)[:3, :3]
        if not np.isfinite(covariance).all():
            return 0.0, np.zeros(3)
        variances, directions = np.linalg.eigh(covariance)
        return max(float(variances[-1]), 0.0) ** 0.5, directions[:, -1]

    @property
    def warnings(self) -> list[str]:
        """What a person should know before using this answer (one calibration, concrete).

        Raises:
            InputError: of a batch.
        """
        check_one(self.status_code)
        found = []
        if self.status == "failed":
            return ["the solve failed: its result holds no usable numbers"]
        if self.status == "unobservable":
            direction = ", ".join(f"{value:.2f}" for value in np.asarray(self.weakest))
            found.append(
                f"not observable: these poses do not determine the tip along ({direction}) of the "
                "tool's frame; tilt the tool about a further axis"
            )
        if self.wrong_frames is not None:
            found.append(self.wrong_frames)
        if self.uncertain:
            sd, along = self._largest_sd()
            direction = ", ".join(f"{value:.2f}" for value in along)
            found.append(
                f"the tip is known to {sd:.1f} mm (SD) along ({direction}) of the tool's frame: "
                "turn the tool farther, about further axes"
            )
        named = outliers(self)
        if named:
            told = listed_outliers(self, AXES)
            verb = "left out" if self.robust else "kept"
            found.append(f"{verb} {len(named)} poses that do not fit the rest: {told}")
        return found

    def record(self) -> dict[str, Any]:
        """What ``jaxcal pivot --json`` prints, as plain values (one calibration, concrete).

        Raises:
            InputError: of a batch.
        """
        from jaxcal.report.pivot import pivot_record

        check_one(self.status_code)
        return pivot_record(self)

    def __str__(self) -> str:
        """Tip, pivot point and their errors; of a batch or traced, the shapes of the arrays."""
        if is_traced(self) or np.ndim(self.status_code):
            return repr(self)
        from jaxcal.report.pivot import pivot_lines

        return "\n".join(pivot_lines(self.record()))


@in_own_modes
def calibrate_pivot(
    poses: Float[AnyArray, "*batch n rows 4"],
    mask: Float[AnyArray, "*#batch n"] | Bool[AnyArray, "*#batch n"] | None = None,
    *,
    robust: bool = True,
) -> Pivot:
    """Find a tool's tip and the point about which it turned.

    Args:
        poses: tool -> tracker, mm, (n, 4, 4) or (n, 3, 4), in the order in which they were taken;
            concrete ones, with a mask that is no traced array, are checked and their rotations
            projected to SO(3). Leading axes make a batch, which is solved as it is.
        mask: True (or 1) for poses to use; all by default. Of concrete poses, not of a batch, those
            that repeat an earlier one exactly are not used.
        robust: find the poses that agree with each other, even if nearly half of all poses are
            wrong, and leave the others out.

    Returns:
        A :class:`Pivot`; read its ``status`` and ``warnings`` before using it.

    Raises:
        InputError: poses or a mask of another shape, or what are no numbers; concrete poses, not
            of a batch, that are not rigid transforms or look like metres, or fewer than 4 used
            ones.
        CalibrationError: this process was forked from one in which JAX had started.
    """
    check_flag("robust", robust)
    executables.refuse_after_fork()
    if not isinstance(poses, jax.Array):
        poses = real_array(poses, "poses")
    shape = np.shape(poses)
    if len(shape) < 3 or shape[-2:] not in ((4, 4), (3, 4)):
        raise InputError(f"poses must have shape (n, 4, 4), not {shape}")
    if not shape[-3]:
        raise InputError(f"0 poses are too few: at least {MINIMUM_IMAGES} are needed")
    if mask is not None and not is_traced(mask):
        mask = truth_array(mask, "mask")
    if mask is not None and np.shape(mask) not in (shape[:-2], shape[-3:-2]):
        raise InputError(f"mask must have shape {shape[:-2]}, not {np.shape(mask)}")
    if not is_traced(poses, mask) and np.ndim(poses) == 3:
        used = np.ones(len(poses), bool) if mask is None else np.asarray(mask) > 0
        poses = check_poses(real_array(poses, "poses"), used)
        mask = used & _first_of_each(poses, used)
        if mask.sum() < MINIMUM_IMAGES:
            count, different = int(used.sum()), int(mask.sum())
            among = "" if different == count else f", {different} of them different,"
            few = f"{counted(count, 'used pose')}{among} {'is' if count == 1 else 'are'} too few"
            raise InputError(f"{few}: at least {MINIMUM_IMAGES} are needed")
        reach = float(np.linalg.norm(poses[used, :3, 3], axis=1).max())
        if 0 < reach < LEAST_REACH_MM:
            raise MetresError(
                f"every position lies within {reach:.3g} mm of the tracker's origin: the poses "
                "look like metres; give them in mm"
            )
    require_float64("jaxcal.calibrate_pivot")
    array = jnp.asarray(poses, np.float64)
    if array.shape[-2] == 3:
        last = jnp.broadcast_to(jnp.array([0.0, 0.0, 0.0, 1.0]), (*array.shape[:-2], 1, 4))
        array = jnp.concatenate([array, last], axis=-2)
    weight = jnp.ones(array.shape[:-2]) if mask is None else jnp.asarray(mask)
    weight = jnp.broadcast_to(weight.astype(array.dtype), array.shape[:-2])
    platform = None if inside_transformation(array, weight) else jax.default_backend()
    if platform == "cpu" and array.ndim == 3:
        found = _solve_kept(np.asarray(array), np.asarray(weight), robust)
        found = jax.device_put(found, next(iter(array.devices())) if array.committed else None)
    else:
        found = compiler.compiled(_solve_all, 2, platform)(array, weight, robust)
    return found if platform is None or array.ndim > 3 else _widened(found)


def _widened(found: Pivot) -> Pivot:
    """One concrete calibration whose covariance counts errors that poses share once."""
    used = np.asarray(found.mask) > 0
    time = alike_for(np.asarray(found.residual)[used]) if found.status == "converged" else 1.0
    if time == 1.0:
        return found
    changed = (found.covariance * time, found.information / time, found.alike_for * time)
    return eqx.tree_at(lambda p: (p.covariance, p.information, p.alike_for), found, changed)


def _first_of_each(
    poses: Float[np.ndarray, "n rows 4"], used: Bool[np.ndarray, " n"]
) -> Bool[np.ndarray, " n"]:
    """Used poses that are no exact copy of an earlier one, as of a tracker read too often."""
    rows = np.flatnonzero(used)
    _, first = np.unique(poses[rows].reshape(len(rows), -1), axis=0, return_index=True)
    return np.isin(np.arange(len(poses)), rows[first])


def _solve_kept(
    poses: Float[np.ndarray, "n 4 4"], mask: Float[np.ndarray, " n"], robust: bool
) -> Pivot:
    """One calibration by a kept program, which serves many numbers of poses."""
    count = len(mask)
    padded = executables.padded_images(count)
    rows = np.minimum(np.arange(padded), count - 1)  # masked poses must be valid, too
    weight = np.where(np.arange(padded) < count, mask[rows], 0.0)
    label = {"method": "pivot", "images": padded, "robust": robust}
    arguments = (poses[rows], weight)
    found = executables.run(_solve_all, arguments, robust, flags=compiler.ONE_PROBLEM, label=label)
    return first_images(found, count)


def _solve_all(
    poses: Float[Array, "*batch n 4 4"], mask: Float[Array, "*batch n"], robust: bool
) -> Pivot:
    solve = partial(_solve, robust=robust)
    for _ in poses.shape[:-3]:
        solve = jax.vmap(solve)
    return solve(poses, mask)


def _solve(poses: Float[Array, "n 4 4"], mask: Float[Array, " n"], *, robust: bool) -> Pivot:
    everything = Problem(
        # Poses that are not used may hold anything.
        poses=jnp.where(mask[:, None, None] > 0, poses, jnp.eye(4, dtype=poses.dtype)),
        measurements=jnp.zeros((*mask.shape, 2), poses.dtype),
        mask=mask,
        spacing=jnp.ones(2, poses.dtype),
        face_offset=jnp.zeros((), poses.dtype),
    )
    model = ConsensusModel(BLOCKS, _errors, _proposals, isotropic=True, subset=_SUBSET)
    keep = find_consensus(everything, model) if robust else mask
    problem = eqx.tree_at(lambda p: p.mask, everything, keep)
    parameters = jax.tree.map(lambda leaf: leaf[0], _proposals(problem, keep[None]))
    # The problem is linear; two steps remove the rounding errors of the moments.
    residual, jacobian = linearise(parameters, problem, model)
    information = jnp.einsum("anm,bnm->ab", jacobian, jacobian)
    for _ in range(2):
        gradient = jnp.einsum("anm,nm->a", jacobian, residual)
        step = dense.solve_symmetric(information, gradient, jnp.diagonal(information))
        parameters = retract(parameters, -step, BLOCKS)
        residual = _errors(parameters, problem)
    studentised = studentised_errors(parameters, everything, keep, model)
    outlier = mask * (1 - keep)
    if not robust:
        judged = jnp.sum(mask) >= FEWEST_TO_LEAVE_OUT
        outlier = mask * judged * stands_out(studentised, keep)
    used = jnp.sum(keep)
    variance = jnp.sum(residual**2) / jnp.maximum(3 * used - 6, 1.0)
    length = jnp.sqrt(jnp.sum(parameters.translation**2))
    finite = jnp.all(jnp.isfinite(parameters.translation))
    failed = jnp.logical_not(finite) | (jnp.sum(mask) < MINIMUM_IMAGES)
    inverse, observed = inverse_and_observability(
        information[..., None],
        information[..., None],
        variance[None],
        jnp.ones((6, 1), poses.dtype),
        LARGEST_SD * jnp.maximum(length, _spread(problem))[None],
    )
    inverse, observed = jax.tree.map(lambda leaf: leaf[..., 0], (inverse, observed))
    unknown = observed.degenerate | observed.weak
    status = jnp.where(unknown, Status.UNOBSERVABLE, Status.CONVERGED)
    return Pivot(
        tip=parameters.translation,
        point=parameters.point,
        covariance=jnp.where(unknown | failed, jnp.nan, variance * inverse),
        sigma=jnp.sqrt(variance),
        rms=jnp.sqrt(jnp.sum(residual**2) / used),
        residual=residual,
        mask=keep,
        outlier=outlier,
        studentised_errors=studentised,
        status_code=jnp.where(failed, Status.FAILED, status).astype(jnp.int32),
        information=information,
        alike_for=jnp.ones_like(variance),
        robust=robust,
    )


def _errors(parameters: Parameters, problem: Problem) -> Float[Array, "n 3"]:
    # The tip is the origin of a tool's "image".
    return problem.mask[:, None] * target_in_image(parameters, problem)


def _spread(problem: Problem) -> Float[Array, ""]:
    """Root mean square distance of the tool's origin from its mean, mm."""
    total = jnp.sum(problem.mask)
    origins = problem.poses[:, :3, 3]
    mean = jnp.sum(problem.mask[:, None] * origins, axis=0) / total
    return jnp.sqrt(jnp.sum(problem.mask[:, None] * (origins - mean) ** 2) / total)


def _proposals(problem: Problem, subsets: Float[Array, "k n"]) -> Parameters:
    """R_i p - c = -t_i for every subset at once, from each pose's moments."""
    rotations, translations = problem.poses[:, :3, :3], problem.poses[:, :3, 3]
    used = problem.mask
    centre = jnp.sum(used[:, None] * translations, axis=0) / jnp.sum(used)
    eye = jnp.broadcast_to(jnp.eye(3, dtype=used.dtype), rotations.shape)
    rows = jnp.concatenate([rotations, -eye, (centre - translations)[..., None]], axis=2)

    def solve(system: Float[Array, "7 7"]) -> Parameters:
        matrix, vector = system[:6, :6], system[:6, 6:]
        ridge = 1e3 * jnp.finfo(system.dtype).eps * jnp.trace(matrix) / 6
        found = dense.solve_positive(matrix + ridge * jnp.eye(6, dtype=matrix.dtype), vector)[:, 0]
        return Parameters.of(jnp.eye(3, dtype=found.dtype), found[:3], found[3:] + centre)

    return jax.vmap(solve)(subset_systems(rows, used, subsets))
