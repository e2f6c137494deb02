"""The answer: transform, target and offsets, how certain they are, and what looked wrong."""

from __future__ import annotations

import enum

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxcal import diagnosis
from jaxcal.errors import CalibrationError
from jaxcal.geometry import AnyArray
from jaxcal.inspection import Inspection
from jaxcal.model.parameters import Blocks
from jaxcal.problem import is_traced
from jaxcal.solvers.auto import OffsetLaw


class Status(enum.IntEnum):
    """How a solve ended; ``Calibration.status`` gives the name in lower case."""

    CONVERGED = 0
    MAX_ITERATIONS = 1
    UNOBSERVABLE = 2
    FAILED = 3


class Calibration(eqx.Module):
    """A calibration of one problem, or of a batch (then every array has the batch axes in front).

    Units are mm and rad; X's perturbations are right ones, X Exp([v, omega]), so they are along and
    about the image's axes (lateral, elevational, axial).

    Attributes:
        image_to_probe: X.
        point: target in the tracker's frame, mm.
        elevation: estimated elevational offset of the target in every image (q_iy), mm; 0 where an
            image was left out.
        elevation_sd: its standard deviation, mm; NaN where it rests on a bound or is not known.
        sigma: SDs of lateral position, range and elevational offset, mm.
        channel_sigma: SD of an element's distance, mm; None for solves on points.
        offset_law: what the data say of the offsets' law, their mean and the noise; None where no
            laws were weighed.
        covariance: of X (v mm, omega rad); NaN where X is not observable.
        point_covariance: of the target, mm^2.
        scale_mm_per_px: [lateral, axial], or None for points in mm.
        sound_speed_m_s: where it was estimated, else None; so are the following.
        sound_speed_sd_m_s: its standard deviation.
        delay_s: electronic delay, s.
        delay_sd_s: its standard deviation.
        sound_speed_prior_m_s: SD that was believed before; None without such a belief.
        delay_prior_s: SD that was believed before, likewise.
        residual: q_i - p_i with p_i in the plane (y = 0), in the image frame, mm.
        rms: root mean square length of those residuals over the used images, mm.
        mask: 1 for used images.
        at_bound: 1 where the offset rests on its bound.
        status_code: a :class:`Status`.
        iterations: linearisations (joint, conventional) or rounds (alternating).
        variance_rounds: variance updates of the self-tuning; 0 without.
        cost: the minimised sum of squares: mm^2 (equal weights) or whitened.
        stationarity: scaled KKT residual of that objective.
        condition: of the information about all unknowns, in scaled units (largest / smallest).
        weakest: unit vector (scaled units) of the least known direction of all unknowns.
        weakest_sd: standard deviation along it, mm at the lever arm; NaN where it has none.
        prior_direction: direction that the measurements alone, without the offset's prior or bound,
            leave undetermined; zeros where there is none.
        searched_start: the closed-form start was unsound and one was searched for.
        inspection: images that stand out, the noise model's fit, and which poses to add.
        sigma_tuned: the SDs were estimated from the data.
        sigma_floored: (3,) which SDs rest on their floor.
        tolerance_met: the method's own stopping rule was met.
        differentiable: gradients through this answer by the implicit function theorem are valid: a
            stationary point, well determined, and no offset about to reach or leave its bound.
        rotation_change: X's last move in rad (alternating), else 0.
        translation_change: X's last move in mm (alternating), else 0.
        trace: objective after each of the first iterations; NaN beyond the last;
            None where none was asked for.
        method: ``conventional``, ``alternating`` or ``joint`` (static).
        prior: ``none``, ``bounded``, ``gaussian``, or, where laws of the offsets were weighed,
            ``auto`` or ``uniform`` (static).
        data: ``points`` or ``channels``: whose residuals were minimised (static).
        blocks: the free unknowns (static).
        robust: images that do not fit the rest were left out (static).
    """

    image_to_probe: Float[Array, "*batch 4 4"]
    point: Float[Array, "*batch 3"]
    elevation: Float[Array, "*batch n"]
    elevation_sd: Float[Array, "*batch n"]
    sigma: Float[Array, "*batch 3"]
    offset_law: OffsetLaw | None
    channel_sigma: Float[Array, "*batch"] | None
    covariance: Float[Array, "*batch 6 6"]
    point_covariance: Float[Array, "*batch 3 3"]
    scale_mm_per_px: Float[Array, "*batch 2"] | None
    sound_speed_m_s: Float[Array, "*batch"] | None
    sound_speed_sd_m_s: Float[Array, "*batch"] | None
    delay_s: Float[Array, "*batch"] | None
    delay_sd_s: Float[Array, "*batch"] | None
    sound_speed_prior_m_s: Float[Array, "*batch"] | None
    delay_prior_s: Float[Array, "*batch"] | None
    residual: Float[Array, "*batch n 3"]
    rms: Float[Array, "*batch"]
    mask: Float[Array, "*batch n"]
    at_bound: Float[Array, "*batch n"]
    status_code: Int[Array, "*batch"]
    iterations: Int[Array, "*batch"]
    variance_rounds: Int[Array, "*batch"]
    cost: Float[Array, "*batch"]
    stationarity: Float[Array, "*batch"]
    condition: Float[Array, "*batch"]
    weakest: Float[Array, "*batch p"]
    weakest_sd: Float[Array, "*batch"]
    prior_direction: Float[Array, "*batch p"]
    searched_start: Bool[Array, "*batch"]
    inspection: Inspection
    sigma_tuned: Bool[Array, "*batch"]
    sigma_floored: Bool[Array, "*batch 3"]
    tolerance_met: Bool[Array, "*batch"]
    differentiable: Bool[Array, "*batch"]
    rotation_change: Float[Array, "*batch"]
    translation_change: Float[Array, "*batch"]
    trace: Float[Array, "*batch trace"] | None
    method: str = eqx.field(static=True)
    prior: str = eqx.field(static=True)
    data: str = eqx.field(static=True)
    blocks: Blocks = eqx.field(static=True)
    robust: bool = eqx.field(static=True, default=False)

    @property
    def converged(self) -> Bool[Array, "*batch"]:
        """Whether the answer is a converged and observable one (traceable)."""
        return jnp.asarray(self.status_code == Status.CONVERGED)

    @property
    def status(self) -> str | np.ndarray:
        """converged, max_iterations, unobservable or failed; an array of such for a batch.

        Raises:
            CalibrationError: under jit, vmap or grad, where text cannot be: use ``status_code``.
        """
        names = np.array([status.name.lower() for status in Status])
        chosen = names[self._concrete(self.status_code)]
        return str(chosen) if chosen.ndim == 0 else chosen

    @property
    def outlier(self) -> Float[AnyArray, "*batch n"]:
        """1 where an image does not fit the rest; a robust solve leaves it out."""
        return self.inspection.outlier

    @property
    def departure(self) -> Float[AnyArray, "*batch n 3"]:
        """Each image's lateral, range and elevational errors in robust SDs of those in use."""
        return self.inspection.departure

    @property
    def images_used(self) -> Int[Array, "*batch"]:
        """Number of used images."""
        return jnp.sum(self.mask > 0, axis=-1)

    @property
    def warnings(self) -> list[str]:
        """What a person should know before using this answer, in words (one problem, concrete)."""
        return diagnosis.warnings(self.numpy())

    @property
    def observability(self) -> dict[str, float | str | None]:
        """condition, weakest_direction (text), weakest_sd_mm, known_only_from_prior (text)."""
        return diagnosis.observability(self.numpy())

    def numpy(self) -> Calibration:
        """The same with numpy arrays (concrete values).

        Raises:
            CalibrationError: under a JAX transformation.
        """
        return jax.tree.map(self._concrete, self)

    @staticmethod
    def _concrete(value: Array | np.ndarray) -> np.ndarray:
        if is_traced(value):
            raise CalibrationError(
                "text is not available under jit, vmap or grad; use the arrays (status_code, "
                "converged, ...) there, and the text outside"
            )
        return np.asarray(value)
