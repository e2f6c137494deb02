"""The answer: transform, target and offsets, how certain they are, and what looked wrong."""

from __future__ import annotations

import enum
import os
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxcal import CalibrationError, InputError
from jaxcal.data.probe import Probe
from jaxcal.data.problem import Problem
from jaxcal.io.given_files import path_name
from jaxcal.model.distributions import OffsetLaw
from jaxcal.model.unknowns import TABLE, Blocks, Values, block_slice, in_image, with_prior
from jaxcal.result.diagnostics import Diagnostics, Inspection
from jaxcal.result.saved import check_target, dated
from jaxcal.result.transform import AppliedPoints, ImageTransform, SaveFormat
from jaxcal.runtime.array_types import AnyArray, Bool, Float, Int
from jaxcal.runtime.arrays import (
    array_module,
    array_tree,
    has_values,
    is_traced,
    map_arrays,
    outline,
    read_only,
    static,
)
from jaxcal.runtime.given_values import check_made
from jaxcal.runtime.one_or_batch import OneOrBatch
from jaxcal.solvers.convergence import Convergence

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Status(enum.IntEnum):
    """How a solve ended; ``Calibration.status`` gives the name in lower case.

    Attributes:
        CONVERGED: the method's own stopping rule was met.
        MAX_ITERATIONS: it was not met within the largest number of iterations.
        UNOBSERVABLE: the images do not determine X.
        FAILED: there is no calibration: too few images, or NaN or Inf.
    """

    CONVERGED = 0
    MAX_ITERATIONS = 1
    UNOBSERVABLE = 2
    FAILED = 3


@array_tree
class Medium:
    """Sound speed and delay, each None where it was not estimated.

    Attributes:
        sound_speed_m_s: estimate, m/s.
        sound_speed_sd_m_s: its SD, m/s.
        sound_speed_prior_m_s: prior SD, m/s; None without a prior.
        delay_s: electronic delay, s.
        delay_sd_s: its SD, s.
        delay_prior_s: prior SD, s; None without a prior.
    """

    sound_speed_m_s: Float[AnyArray, "*batch"] | None = None
    sound_speed_sd_m_s: Float[AnyArray, "*batch"] | None = None
    sound_speed_prior_m_s: Float[AnyArray, "*batch"] | None = None
    delay_s: Float[AnyArray, "*batch"] | None = None
    delay_sd_s: Float[AnyArray, "*batch"] | None = None
    delay_prior_s: Float[AnyArray, "*batch"] | None = None

    @classmethod
    def of(
        cls,
        values: Values,
        covariance: Float[AnyArray, "*batch p p"],
        blocks: Blocks,
        problem: Problem,
        prior_sd: Float[AnyArray, "*batch k"] | None = None,
    ) -> Medium:
        """Those of sound speed and delay that are free (traceable).

        Args:
            values: of the free further unknowns (:func:`jaxcal.model.unknowns.measured`).
            covariance: of all unknowns.
            blocks: the free unknowns.
            problem: for its nominal sound speed and delay.
            prior_sd: prior SDs of those that have one (:func:`jaxcal.model.unknowns.with_prior`),
                m/s and s.
        """
        xp, speed = array_module(covariance), problem.nominal_sound_speed
        prior: dict[str, Any] = {}
        found: dict[str, Any] = {}
        if prior_sd is not None:
            prior = dict(zip(with_prior(blocks), xp.moveaxis(prior_sd, -1, 0), strict=True))

        def step_sd(name: str) -> Any:
            at = block_slice(blocks, name).start
            return xp.sqrt(covariance[..., at, at])

        if "sound-speed" in blocks:
            estimate = speed * values["sound-speed"][0]
            found["sound_speed_m_s"] = xp.asarray(estimate)
            found["sound_speed_sd_m_s"] = xp.asarray(estimate * step_sd("sound-speed"))
            found["sound_speed_prior_m_s"] = prior.get("sound-speed")
        if "delay" in blocks:
            nominal, mm_per_s = 0.0 if problem.delay is None else problem.delay, 1e3 * speed
            found["delay_s"] = xp.asarray(nominal + values["delay"][0] / mm_per_s)
            found["delay_sd_s"] = xp.asarray(step_sd("delay") / mm_per_s)
            found["delay_prior_s"] = prior.get("delay")
        return cls(**found)


@array_tree
class Linearisation:
    """The normal matrices at the answer; tangents are in the order of ``Calibration.blocks``.

    Attributes:
        information: of the whitened residuals, offsets eliminated (mm, rad, log units).
        design: of the unweighted residuals, offsets known.
        variance: of the residuals behind ``information``: 1 where they are whitened, else mm^2.
        tracker_sd: SD of the tracked position, mm, or None.
        average_elevation_sd: SDs of the offsets under the average over distributions, mm, or None.
        further: values of the free further unknowns in the order of ``Calibration.blocks``: factors
            on the nominal values, and mm (:func:`jaxcal.model.unknowns.measured`); None if there
            are none.
        prior_sd: SDs of the Gaussian priors of those that have one
            (:func:`jaxcal.model.unknowns.with_prior`), of their steps (relative, mm or rad); None
            without a prior.
    """

    information: Float[AnyArray, "*batch p p"]
    design: Float[AnyArray, "*batch p p"]
    variance: Float[AnyArray, "*batch"]
    tracker_sd: Float[AnyArray, "*batch"] | None
    average_elevation_sd: Float[AnyArray, "*batch n"] | None
    further: Float[AnyArray, "*batch k"] | None
    prior_sd: Float[AnyArray, "*batch priors"] | None = None


@array_tree
class Calibration(OneOrBatch):
    """A calibration of one problem, or of a batch (then every array has the batch axes in front).

    Units are mm and rad. Perturbations of X are right perturbations, X Exp([v, omega]), so they are
    along and about the image's axes (lateral, elevational, axial).

    The attributes below are arrays of the solve and are available under jit, vmap and grad. The
    properties that are numpy arrays or text are computed on the host when they are first read, for
    the whole batch at once (:mod:`jaxcal.diagnostics`); reading one of them inside a transformation
    is an error.

    Attributes:
        image_to_probe: X, rigid, mm. In files and in :class:`jaxcal.ImageTransform`, beside PLUS's
            ImageToProbe, which includes the pixel size, it is ``image_plane_to_probe``.
        point: target in the tracker's frame, mm.
        elevation: estimated elevational offset of the target in every image (q_iy), mm; 0 where an
            image was left out.
        sigma: SDs of lateral position, range and elevational offset, mm.
        offset_law: what the data say about the distribution of the offsets, their mean and the
            noise; None if no distributions were compared.
        channel_sigma: SD of an element's distance, mm; None for solves on points.
        unknowns_covariance: covariance of all unknowns, in the order of ``blocks`` (mm, rad, log
            units); NaN where X is not observable or the solve failed.
        scale_mm_per_px: [lateral, axial], or None for points in mm.
        medium: sound speed and delay.
        rms: root mean square of ``residual``'s length over the used images, mm.
        mask: 1 for used images.
        status_code: a :class:`Status`.
        differentiable: whether gradients through this answer by the implicit function theorem are
            valid: it is a stationary point, it is well determined, and no offset is about to reach
            or leave its bound.
        sigma_tuned: the SDs were estimated from the data.
        convergence: how the method ended.
        linearisation: the normal matrices, from which the properties are computed.
        problem: the data that were solved, including images left out.
        method: ``conventional``, ``alternating`` or ``joint`` (static).
        prior: ``none``, ``bounded``, ``gaussian``, or, if distributions of the offsets were
            compared, ``auto`` or ``uniform`` (static).
        data: ``points`` or ``channels``, whichever residuals were minimised (static).
        blocks: the free unknowns (static).
        robust: images that do not fit the rest were left out (static).
        notes: what was done to the data before the solve, in words (static; one problem).
        probe: the transducer, if a recording named it; its face is part of the region that errors
            are stated for (static; one problem).
        frame_size: (columns, rows) of the frames, px, if a recording has it; the same region does
            not leave them (static; one problem).
        pose_frames: names of the poses' two frames, if a recording has them (static; one problem).
    """

    image_to_probe: Float[AnyArray, "*batch 4 4"]
    point: Float[AnyArray, "*batch 3"]
    elevation: Float[AnyArray, "*batch n"]
    sigma: Float[AnyArray, "*batch 3"]
    offset_law: OffsetLaw | None
    channel_sigma: Float[AnyArray, "*batch"] | None
    unknowns_covariance: Float[AnyArray, "*batch p p"]
    scale_mm_per_px: Float[AnyArray, "*batch 2"] | None
    medium: Medium
    rms: Float[AnyArray, "*batch"]
    mask: Float[AnyArray, "*batch n"]
    status_code: Int[AnyArray, "*batch"]
    differentiable: Bool[AnyArray, "*batch"]
    sigma_tuned: Bool[AnyArray, "*batch"]
    convergence: Convergence
    linearisation: Linearisation
    problem: Problem | None
    method: str = static()
    prior: str = static()
    data: str = static()
    blocks: Blocks = static()
    robust: bool = static(default=False)
    notes: tuple[str, ...] = static(default=())
    probe: Probe | None = static(default=None)
    frame_size: tuple[int, int] | None = static(default=None)
    pose_frames: tuple[str, str] | None = static(default=None)

    @property
    def converged(self) -> Bool[AnyArray, "*batch"]:
        """Whether the solve converged and X is observable (traceable)."""
        # A JAX array's own operators trace inside a jit, even if the array has values.
        xp = array_module(self.status_code)
        return xp.asarray(xp.asarray(self.status_code) == Status.CONVERGED)

    @property
    def images_used(self) -> Int[AnyArray, "*batch"]:
        """Number of used images (traceable)."""
        xp = array_module(self.mask)
        return xp.asarray(xp.sum(xp.asarray(self.mask) > 0, axis=-1))

    @property
    def covariance(self) -> Float[AnyArray, "*batch 6 6"]:
        """Covariance of X (v mm, omega rad); NaN where that of all unknowns is."""
        return self.unknowns_covariance[..., :6, :6]

    @property
    def point_covariance(self) -> Float[AnyArray, "*batch 3 3"]:
        """Covariance of the target in the tracker's frame, mm^2."""
        return self.unknowns_covariance[..., 6:9, 6:9]

    @property
    def status(self) -> str | np.ndarray:
        """converged, max_iterations, unobservable or failed; an array of these for a batch.

        Raises:
            CalibrationError: under jit, vmap or grad, where there is no text: use ``status_code``.
        """
        _refuse_traced(self.status_code)
        return status_names(np.asarray(self.status_code))

    @cached_property
    def _diagnostics(self) -> Diagnostics:
        """The diagnostics, computed when one of them is first read."""
        from jaxcal.diagnostics.diagnose import diagnose

        answer = self.numpy()
        return read_only(diagnose(self)) if answer is self else answer._diagnostics

    @property
    def elevation_sd(self) -> Float[np.ndarray, "*batch n"]:
        """SD of ``elevation``, mm; NaN where an offset rests on its bound or is not known."""
        return self._diagnostics.elevation_sd

    @property
    def residual(self) -> Float[np.ndarray, "*batch n 3"]:
        """q_i - p_i with p_i in the plane (y = 0), in the image frame, mm."""
        return self._diagnostics.residual

    @property
    def at_bound(self) -> Float[np.ndarray, "*batch n"]:
        """1 where the offset rests on its bound."""
        return self._diagnostics.at_bound

    @property
    def condition(self) -> Float[np.ndarray, "*batch"]:
        """Largest over smallest eigenvalue of all unknowns' information, in scaled units."""
        return self._diagnostics.condition

    @property
    def weakest(self) -> Float[np.ndarray, "*batch p"]:
        """Unit vector (scaled units) of the least well determined direction of all unknowns."""
        return self._diagnostics.weakest

    @property
    def weakest_sd(self) -> Float[np.ndarray, "*batch"]:
        """SD along ``weakest``, mm at the lever arm; NaN where there is no finite SD."""
        return self._diagnostics.weakest_sd

    @property
    def prior_direction(self) -> Float[np.ndarray, "*batch p"]:
        """Direction that the measurements do not determine without the offsets' prior or bound.

        It is a unit vector in scaled units; zeros where there is no such direction.
        """
        return self._diagnostics.prior_direction

    @property
    def inspection(self) -> Inspection:
        """Images that stand out, the noise model's fit, and which poses to add."""
        return self._diagnostics.inspection

    @property
    def outlier(self) -> Float[np.ndarray, "*batch n"]:
        """1 where an image does not fit the rest; a robust solve leaves it out."""
        return self._diagnostics.inspection.outlier

    @property
    def studentised_errors(self) -> Float[np.ndarray, "*batch n 3"]:
        """Each image's lateral, range and elevational errors, in robust SDs of the used images.

        They are corrected for leverage.
        """
        return self._diagnostics.inspection.studentised_errors

    @cached_property
    def wrong_frames(self) -> str | None:
        """What is wrong with the data's frames or units, in words, and what to do (one problem).

        None where nothing seems wrong; see :mod:`jaxcal.diagnostics.frame_checks`. If there is
        a text, do not use the answer, however small its residuals and standard deviations are.

        Raises:
            CalibrationError: under a JAX transformation.
            InputError: of a batch.
        """
        from jaxcal.diagnostics.frame_checks import wrong_frames

        check_one(self.status_code)
        if (answer := self.numpy()) is not self:
            return answer.wrong_frames
        if self.problem is None:
            return None
        return wrong_frames(replace(self.problem, mask=self.mask), self.blocks)

    @cached_property
    def doubtful_unit(self) -> str | None:
        """Why the poses may be in another unit than mm, in words, and what to do (one problem).

        None without a sign of it. If there is a text, the error to expect is not known.

        Raises:
            CalibrationError: under a JAX transformation.
            InputError: of a batch.
        """
        from jaxcal.diagnostics.frame_checks import doubtful_unit

        check_one(self.status_code)
        if (answer := self.numpy()) is not self:
            return answer.doubtful_unit
        if self.problem is None or self.wrong_frames is not None:
            return None
        return doubtful_unit(replace(self.problem, mask=self.mask))

    @property
    def warnings(self) -> list[str]:
        """What a person should know before using this answer, in words (one problem).

        Raises:
            CalibrationError: without its problem, or under a JAX transformation.
            InputError: of a batch.
        """
        from jaxcal.diagnostics.warnings import warnings

        return warnings(self.numpy())

    @property
    def observability(self) -> dict[str, float | str | None]:
        """condition, weakest_sd_mm; in words weakest_direction, known_only_from_prior, advice.

        Raises:
            CalibrationError: without its problem, or under a JAX transformation.
            InputError: of a batch.
        """
        from jaxcal.diagnostics.directions import observability

        return observability(self)

    def with_problem(self, problem: Problem) -> Calibration:
        """The same calibration with the data that were solved.

        Raises:
            InputError: something else than a problem, or one with another number of images.
        """
        check_made("problem", problem, Problem, "jaxcal.Problem.from_recording or from_arrays")
        if problem.mask.shape != self.mask.shape:
            raise InputError(
                f"problem must hold the images of this calibration: its mask has shape "
                f"{problem.mask.shape}, not {self.mask.shape}"
            )
        return replace(self, problem=problem)

    def image_transform(self) -> ImageTransform:
        """The transform alone, to apply it to pixels and to save it for other programs.

        Raises:
            CalibrationError: under a JAX transformation.
            InputError: of a batch.
        """
        from jaxcal.diagnostics.intervals import (
            degrees_of_freedom,
            range_of_row_zero,
            variance_factor,
        )

        answer = self.numpy()
        check_one(answer.status_code)
        left = float(degrees_of_freedom(answer))
        scale = answer.scale_mm_per_px
        known = np.isfinite(answer.unknowns_covariance).all()
        origin, factor = range_of_row_zero(answer)
        rows = in_image(answer.blocks)
        return ImageTransform(
            image_plane_to_probe=np.asarray(answer.image_to_probe),
            scale_mm_per_px=None if scale is None else np.asarray(scale),
            face_offset_mm=float(origin),
            covariance=np.asarray(answer.covariance) if known else None,
            error_mm=float(answer.rms),
            converged=bool(self.converged) and self.wrong_frames is None,
            source="the calibration",
            range_factor=float(factor),
            unknowns=tuple(name for name in answer.blocks if TABLE[name].in_image),
            image_covariance=(
                np.asarray(answer.unknowns_covariance)[rows[:, None], rows] if known else None
            ),
            probe_frame=(self.pose_frames or ("Probe",))[0],
            degrees_of_freedom=left if np.isfinite(left) else None,
            variance_factor=float(variance_factor(answer)),
            doubtful_unit=self.doubtful_unit if self.converged else None,
        )

    def plus_matrix(self) -> Float[np.ndarray, "4 4"]:
        """PLUS's ImageToProbe; see :meth:`jaxcal.ImageTransform.plus_matrix`."""
        return self.image_transform().plus_matrix()

    def apply(
        self,
        pixels: np.ndarray,
        pose: np.ndarray | None = None,
        *,
        pixel_sd_px: float | tuple[float, float] = 0.0,
    ) -> AppliedPoints:
        """Image points in the probe's or the tracker's frame; see :meth:`ImageTransform.apply`."""
        return self.image_transform().apply(pixels, pose, pixel_sd_px=pixel_sd_px)

    def record(self, tre_points: tuple[tuple[float, float], ...] = ()) -> dict[str, Any]:
        """What ``jaxcal calibrate --json`` prints, as plain values.

        The command line also looks for images that lag behind their poses. This takes the probe's
        velocities from the recording, which a calibration does not hold.

        Args:
            tre_points: further image points, in the images' unit, for which to give the error.

        Raises:
            CalibrationError: without its problem, or under a JAX transformation.
            InputError: a batch, or points that are not pairs of numbers up to 1e7.
        """
        from jaxcal.report.in_memory import record_of

        return record_of(self, tre_points)

    def verdict(self) -> list[str]:
        """How accurate the calibration is, what limits it and what to do, in sentences.

        Raises:
            CalibrationError: without its problem, or under a JAX transformation.
            InputError: a batch.
        """
        from jaxcal.report.verdict import verdict

        return verdict(self.record())

    def save(self, path: str | os.PathLike[str], format: SaveFormat | None = None) -> None:
        """Write the calibration, complete or not at all; :func:`jaxcal.load_calibration` reads it.

        Args:
            path: the file to make; only a calibration in the same format is replaced.
            format: as for :meth:`jaxcal.ImageTransform.save`; by default that of the extension.
                ``json`` holds the whole record of the calibration.

        Raises:
            InputError: an extension of another or no format, an existing file of another kind, an
                unknown pixel size, a batch, or a calibration that must not be used, in any format
                but ``json``.
            OutputError: the file could not be written and is unchanged.
        """
        if check_target(path, format) == "json":
            from jaxcal.report.write import write_json

            write_json(path, dated(self.record()))
            return
        transform = self.image_transform()
        # Of the other formats .npz alone holds what the verdict expects.
        if self.problem is not None and path_name(path).lower().endswith(".npz"):
            transform = replace(transform, tre_factor=self._tre_factor())
        transform.save(path, format)

    def _tre_factor(self) -> float:
        """How many times larger than the covariance says the verdict expects errors to be."""
        return (self.record()["tre"] or {}).get("factor", 1.0)

    def report(self, path: str | os.PathLike[str]) -> None:
        """Write one page for a browser, as ``jaxcal calibrate --report`` does.

        Raises:
            CalibrationError: without its problem, or under a JAX transformation.
            InputError: the file exists and is no such page, or is not named .html.
            OutputError: it could not be written and is unchanged.
        """
        from jaxcal.report.in_memory import recording_of
        from jaxcal.report.page import write_page

        write_page(path, dated(self.record()), self, recording_of(self))

    def plot_tre(self) -> Figure:
        """Map of the error to expect over the image (matplotlib)."""
        from jaxcal.report import plots

        return plots.plot_tre(self, self._tre_factor())

    def plot_residuals(self) -> Figure:
        """Residual of every image (matplotlib)."""
        from jaxcal.report import plots

        return plots.plot_residuals(self)

    def plot_offsets(self, truth: np.ndarray | None = None) -> Figure:
        """Estimated elevational offsets (matplotlib), beside true ones (mm) where given."""
        from jaxcal.report import plots

        return plots.plot_offsets(self, truth)

    def plot_influence(self) -> Figure:
        """How far leaving out each image moves the calibration (matplotlib)."""
        from jaxcal.report import plots

        return plots.plot_influence(self)

    def plot_limits(self) -> Figure:
        """Where the errors come from (matplotlib)."""
        from jaxcal.report import plots

        return plots.plot_limits(self)

    def __repr__(self) -> str:
        """Method, how it ended, number of images and residual; not the arrays."""
        if not has_values(self.mask, self.status_code, self.rms):
            return outline(self)
        how = self.method if self.prior == "none" else f"{self.method}, prior {self.prior}"
        if np.ndim(self.mask) != 1:
            return f"Calibration({how}, {batch_in_words(self)})"
        count = f"{np.count_nonzero(np.asarray(self.mask) > 0)} used of {len(self.mask)} images"
        return f"Calibration({how}, {self.status}, {count}, RMS {float(self.rms):.3g} mm)"

    def __str__(self) -> str:
        """Table and verdict; for a batch how many converged; without data or values, the repr."""
        if not self._is_complete():
            return repr(self)
        from jaxcal.report import in_memory

        if np.ndim(self.mask) != 1:
            return in_memory.batch_text(self)
        return in_memory.text_of(self)

    def _repr_html_(self) -> str | None:
        """HTML for notebooks; None, so that the text is shown, if there is nothing to draw."""
        if not self._is_complete() or np.ndim(self.mask) != 1:
            return None
        from jaxcal.report.in_memory import html_of

        return html_of(self)

    def _is_complete(self) -> bool:
        """Whether it holds its data, and values everywhere."""
        complete = self.problem is not None and has_values(self.mask, self.status_code)
        return complete and not is_traced(self)

    def numpy(self) -> Calibration:
        """The same calibration with numpy arrays (concrete values); itself if it has no others.

        It is the same object every time, so that diagnostics are computed once.

        Raises:
            CalibrationError: under a JAX transformation.
        """
        _refuse_traced(self)
        return self._in_numpy or self

    @cached_property
    def _in_numpy(self) -> Calibration | None:
        """The calibration with numpy arrays; None if it has no others."""
        others: list[AnyArray] = []

        def converted(leaf: AnyArray) -> np.ndarray:
            values = np.asarray(leaf)
            if values is not leaf:
                others.append(leaf)
            return values

        found = map_arrays(converted, self)
        return found if others else None


def _refuse_traced(value: Any) -> None:
    """Raise CalibrationError for what a JAX transformation traces."""
    if is_traced(value):
        raise CalibrationError(
            "texts, and what is computed by numpy, are not available under jit, vmap or grad: use "
            "the arrays (status_code, converged, ...) there, and the rest outside"
        )


def status_names(status_code: Int[np.ndarray, "*batch"]) -> str | np.ndarray:
    """The name of a :class:`Status`, or of each in an array."""
    chosen = np.array([status.name.lower() for status in Status])[status_code]
    return str(chosen) if chosen.ndim == 0 else chosen


def check_one(status_code: Int[AnyArray, "*batch"]) -> None:
    """Raise InputError where each calibration of a batch has a status."""
    if np.ndim(status_code):
        raise InputError("a batch holds many calibrations: take one of them, batch[0]")


def batch_in_words(batch: Calibration) -> str:
    """The size of a batch, and how many of its calibrations ended with each status."""
    names, counts = np.unique(batch.status, return_counts=True)
    told = ", ".join(f"{count} {name}" for name, count in zip(names, counts, strict=True))
    return f"batch of {' x '.join(map(str, np.shape(batch.status)))}: {told or 'empty'}"


def data_of(calibration: Calibration) -> Problem:
    """The data that were solved.

    Raises:
        CalibrationError: they are not held.
    """
    if calibration.problem is None:
        raise CalibrationError(
            "this needs the data, and this calibration does not hold its problem: add it with "
            "calibration.with_problem(problem)"
        )
    return calibration.problem
