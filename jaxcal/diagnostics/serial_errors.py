"""Errors that are alike in successive images, and what a fit explains in spite of them.

A hand that scans, a tracker and speckle have errors that change slowly in the course of a stream.
So does the pose, and then all that depends on the pose seems to explain these errors. Of each kind
of errors e, with rho the correlation of successive images,

    e_i - rho e_(i-1)    (the first one times sqrt(1 - rho^2))

are independent; their derivatives are those of e, subtracted in the same way. rho comes from what
is left of the errors after the fit of what may have been left out, corrected for the share that any
fit takes away: of independent errors with variance v, what is left has the covariance v (I - H),
with H the fit's projection.

References: Cochrane and Orcutt 1949 (regression with such errors); Prais and Winsten 1954 (the
first one).
"""

from __future__ import annotations

import numpy as np

from jaxcal.runtime.array_types import Float

_CLEAR = 1.0
"""A correlation of less than so many SDs, 1 / sqrt(n), counts as none."""
_LARGEST = 0.95
"""No correlation is taken for larger."""


def correlation(
    errors: Float[np.ndarray, "n kinds"],
    rows: Float[np.ndarray, "n kinds q"],
    variance: Float[np.ndarray, " kinds"],
    precision: Float[np.ndarray, " q"],
) -> Float[np.ndarray, " kinds"]:
    """Correlation of successive images, of each kind of errors; 0 where it is not clear.

    Args:
        errors: of successive images, before the fit.
        rows: their derivatives by all that is fitted.
        variance: of the errors of each kind.
        precision: what is believed of each fitted value beforehand, as 1 / variance about 0.
    """
    count, kinds, size = rows.shape
    weight = 1 / np.sqrt(variance)
    design = (rows * weight[:, None]).reshape(-1, size)
    scale = 1 / np.sqrt(np.maximum(np.sum(design**2, axis=0) + precision, 1e-300))
    whole = np.concatenate([design, np.diag(np.sqrt(precision))]) * scale
    basis = np.linalg.qr(whole)[0][: count * kinds]
    own = (errors * weight).ravel()
    left = (own - basis @ (basis.T @ own)).reshape(count, kinds)
    basis = basis.reshape(count, kinds, size)
    lost, lost_after = (np.sum(basis[k:] * basis[: count - k], axis=(0, 2)) for k in (0, 1))
    squares = np.sum(left**2, axis=0)
    expected = squares / np.maximum(count - lost, 1.0)
    successive = np.sum(left[1:] * left[:-1], axis=0) + expected * lost_after
    found = successive / np.maximum(squares + expected * lost, 1e-300)
    return np.where(found > _CLEAR / np.sqrt(count), np.minimum(found, _LARGEST), 0.0)


def independent(
    of_images: Float[np.ndarray, "n kinds *q"], rho: Float[np.ndarray, " kinds"]
) -> Float[np.ndarray, "n kinds *q"]:
    """Errors, or their rows, of which those of successive images are independent."""
    rho = rho.reshape(-1, *[1] * (of_images.ndim - 2))
    first = np.sqrt(1 - rho**2) * of_images[:1]
    return np.concatenate([first, of_images[1:] - rho * of_images[:-1]])
