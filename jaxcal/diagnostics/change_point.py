"""Where in a recording something has changed at once.

With e the errors of the images, J their derivatives by the unknowns and K those by what changes,
the step theta before image s is fitted to e + J d + h_s K theta, where h_s is -1/2 before it and
1/2 from it on. Sums over the images before every s give all places at once.

Reference: Andrews 1993 (a change at an unknown place).
"""

from __future__ import annotations

import math

import numpy as np

from jaxcal.runtime.array_types import Float

Array = np.ndarray

_FEWEST_EACH_SIDE, _LEAST_SHARE = 3, 0.1
"""Least number of images before and after a step, and their least share: a few successive images of
a stream have errors in common."""


def change_point(
    errors: Float[Array, "m 3"],
    known: Float[Array, "m 3 p"],
    own: Float[Array, "m 3 k"],
    variance: Float[Array, " 3"],
) -> int:
    """After how many of the images a step lowers the sum of squares most.

    Args:
        errors: e, of successive images.
        known: J, their derivatives by the unknowns.
        own: K, those by what changes.
        variance: of the errors of each kind; it stays as it is.
    """
    weight = 1 / np.sqrt(variance)
    errors, own = errors * weight, own * weight[:, None]
    scale = np.sqrt(np.maximum(np.sum(known**2, axis=(0, 1)), 1e-300))
    basis = np.linalg.qr((known / scale * weight[:, None]).reshape(-1, len(scale)))[0]
    rest = errors.ravel() - basis @ (basis.T @ errors.ravel())

    first = max(_FEWEST_EACH_SIDE, math.ceil(_LEAST_SHARE * len(errors)))
    places = np.arange(first, len(errors) - first + 1)

    def step(of_images: Array) -> Array:
        """Half the sum over the images after each place, less half of that before it."""
        return 0.5 * of_images.sum(axis=0) - np.cumsum(of_images, axis=0)[places - 1]

    # For every place at once: what the step and the unknowns have in common, and the errors.
    common = step(np.einsum("mik,mip->mkp", own, basis.reshape(*errors.shape, -1)))
    gradient = step(np.einsum("mik,mi->mk", own, rest.reshape(errors.shape)))
    normal = 0.25 * np.einsum("mik,mil->kl", own, own) - common @ np.swapaxes(common, 1, 2)
    inverse = np.linalg.pinv(normal, rcond=1e-9, hermitian=True)
    gains = np.einsum("sk,skl,sl->s", gradient, inverse, gradient)
    return int(places[np.argmax(gains)])
