"""Times of flight as errors of points: what all elements of an image say of its point.

The elements' distances d_j to the target q of an image have errors e_j and derivatives R_j by the
unknowns. With G their derivatives by q's lateral position and range (the offset held), the point
that fits them is off by

    p = (G' G)^-1 G' e,    with derivatives P = (G' G)^-1 G' R,

to first order, and its covariance is (G' G)^-1 times the variance of one distance. So what is
looked for in errors of points (:mod:`jaxcal.diagnostics.unmodelled`) can be looked for in times of
flight. An estimated sound speed or delay is taken for known: the times within each image determine
it far better than the points do.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from jaxcal.diagnostics.image_errors import ImageErrors
from jaxcal.model.unknowns import RIGID, RIGID_UNKNOWNS
from jaxcal.result.calibration import Calibration
from jaxcal.runtime.array_types import Float

Array = np.ndarray

_LEAST_DETERMINANT = 1e-9
"""Least determinant of G' G: an image of one element, or of elements in one place, has no point."""


def as_points(answer: Calibration) -> tuple[Calibration, ImageErrors, Float[Array, "n 2"]]:
    """A calibration from channels as one from points, and the errors of these points.

    Args:
        answer: of one problem, with a leading axis of length 1.

    Returns:
        The answer, whose problem has points with covariances of their own (of distances with an
        SD of 1 mm), whose mask is 0 where the elements do not determine a point, and whose unknowns
        are X and the target; the errors, mm; and by how much the points are off, [lateral, range],
        mm, if all distances are too long by their own size.
    """
    assert answer.problem is not None
    channels = answer.problem.channels
    assert channels is not None
    seen = ImageErrors.of_answer(answer).centred(answer)
    elements = np.asarray(channels.elements)[:, None]
    heard = seen.mask[..., None] * np.nan_to_num(np.asarray(channels.heard))
    to_point, covariance = _to_point(seen.q, elements, heard)
    known = np.asarray(answer.mask) * seen.mask * (np.linalg.det(covariance) > 0)

    errors, rows = seen.errors.copy(), seen.rows.copy()
    by_element = seen.channel_rows().reshape(*heard.shape, -1)
    errors[..., :2] = (to_point @ seen.channel_errors()[..., None])[..., 0]
    rows[..., :2, :] = to_point @ by_element
    off = seen.errors[..., :2] - errors[..., :2]
    points = replace(
        seen,
        # The measured point is the prediction less its error.
        lateral=seen.lateral + off[..., 0],
        distance=seen.distance + off[..., 1],
        errors=errors * known[..., None],
        rows=rows[..., :RIGID_UNKNOWNS] * known[..., None, None],
        mask=known,
        blocks=RIGID,
        problem=replace(answer.problem, covariance=covariance, mask=known),
    )
    law = answer.offset_law
    if law is not None:
        law = replace(law, own_probability=np.ones_like(np.asarray(law.own_probability)))
    as_answer = replace(
        answer, data="points", problem=points.problem, mask=known, offset_law=law, blocks=RIGID
    )
    far = np.linalg.norm(seen.q[:, :, None] - elements, axis=-1)
    return as_answer, points, (to_point @ far[..., None])[0, ..., 0]


def excess_of_points(
    points: Float[Array, "m 2"], elements: Float[Array, "e 3"]
) -> Float[Array, "m 2"]:
    """By how much points are off, [lateral, range], if distances are too long by their own size.

    Args:
        points: [lateral, axial] in the image plane, mm.
        elements: [lateral, elevational, axial] of the array's elements, image frame, mm.

    Returns:
        [lateral, range], mm; zeros where the elements do not determine a point.
    """
    q = np.insert(points, 1, 0.0, axis=1)[None]
    far = np.linalg.norm(q[:, :, None] - elements, axis=-1)
    to_point, _ = _to_point(q, elements[None, None], np.ones_like(far))
    return (to_point @ far[..., None])[0, ..., 0]


def _to_point(
    q: Float[Array, "k n 3"], elements: Float[Array, "#k #n e 3"], heard: Float[Array, "k n e"]
) -> tuple[Float[Array, "k n 2 e"], Float[Array, "k n 2 2"]]:
    """(G' G)^-1 G' and (G' G)^-1; zeros where the elements do not determine a point."""
    apart = q[:, :, None] - elements
    far = np.linalg.norm(apart, axis=-1)
    # Along the image's axial direction z moves by r / z if the range r moves by 1.
    in_front = (q[..., 2] > 0)[..., None]
    stretch = np.hypot(q[..., 1], q[..., 2]) / np.where(q[..., 2] > 0, q[..., 2], 1.0)
    g = np.stack([apart[..., 0], apart[..., 2] * stretch[..., None]], axis=-1)
    g = g * (in_front * heard / np.where(far > 0, far, 1.0))[..., None]
    normal = np.swapaxes(g, -1, -2) @ g
    known = (np.linalg.det(normal) > _LEAST_DETERMINANT)[..., None, None]
    inverse = np.linalg.inv(np.where(known, normal, np.eye(2))) * known
    return inverse @ np.swapaxes(g, -1, -2), inverse
