"""What to acquire, and the poses that follow from it."""

from __future__ import annotations

import os
from dataclasses import dataclass

import numpy as np

from hw.planning.pool import allowed_by, plan_pool
from hw.planning.poses import PosePlan, plan_poses
from hw.recording.check import settings_of
from hw.runtime.choices import (
    CONTROLLERS,
    OPERATORS,
    PHANTOMS,
    PLACEMENTS,
    PLACEMENTS_OF,
    PLANS,
)
from hw.setup.description import Setup
from jaxcal import InputError
from jaxcal.io.given_files import naming
from jaxcal.runtime.given_values import LARGEST_SEED, whole_number

MOST_IMAGES = 1000


@dataclass(frozen=True)
class AcquisitionRequest:
    """What to acquire.

    Attributes:
        images: poses of the plan; with ``optimal`` the most images.
        placement: one of :data:`PLACEMENTS`.
        seed: of the plan.
        every_frame: record every ultrasound frame, not one an image.
        bench: seed of the emulated bench; None for a real one.
        operator: one of :data:`OPERATORS`: who follows the injected pattern, a person at the
            terminal or before a window, or a rule.
        plan: one of :data:`PLANS`; ``optimal`` chooses from a pool by the images taken so far.
        until_tre_mm: with ``optimal``: stop once the predicted TRE is no larger than this.
        phantom: one of :data:`PHANTOMS`: what is in the tank. A cross-wire is placed and measured
            by what the images show, the other phantoms by the electronics.
        controller: one of :data:`CONTROLLERS`: series of the emulated bench's robot.
    """

    images: int = 60
    placement: str = "amplitude-scan"
    seed: int = 0
    every_frame: bool = False
    bench: int | None = None
    operator: str = "simulated"
    plan: str = "sobol"
    until_tre_mm: float | None = None
    phantom: str = PHANTOMS[0]
    controller: str = CONTROLLERS[0]

    def __post_init__(self) -> None:
        for name, choices in (
            ("phantom", PHANTOMS),
            ("controller", CONTROLLERS),
            ("plan", PLANS),
            ("placement", PLACEMENTS),
            ("operator", OPERATORS),
        ):
            if getattr(self, name) not in choices:
                raise InputError(f"{name} must be one of {', '.join(choices)}")
        wanted = self.until_tre_mm
        if wanted is not None and not (np.isfinite(wanted) and wanted > 0):
            raise InputError(f"until_tre_mm must be a positive number of mm, not {wanted}")
        if wanted is not None and self.plan != "optimal":
            raise InputError("until_tre_mm needs the plan optimal")
        if self.placement not in PLACEMENTS_OF[self.phantom]:
            fitting = " or ".join(PLACEMENTS_OF[self.phantom])
            raise InputError(f"with the {self.phantom} placement is {fitting}")
        whole_number("images", self.images, 4, MOST_IMAGES)
        whole_number("seed", self.seed, 0, LARGEST_SEED)
        if self.bench is not None:
            whole_number("bench", self.bench, 0, LARGEST_SEED)

    @property
    def by_image(self) -> bool:
        """Whether images serve for placement and measurement, instead of the electronics."""
        return self.phantom == "cross-wire"

    @property
    def kind(self) -> str:
        """What the selected images of the recording hold."""
        return "point" if self.by_image else "time_of_flight"


def planned(setup: Setup, request: AcquisitionRequest) -> PosePlan:
    """The poses of a request: a plan in the order of travel, or the pool of an optimal one.

    Raises:
        InputError: box, reach and limits leave too few poses, or the setup lacks a device.
    """
    if request.by_image and setup.ultrasound is None:
        raise InputError(f"a {request.phantom} needs the images: add [ultrasound] to the setup")
    if request.plan == "sobol":
        return plan_poses(request.images, setup.scene, setup.extent, request.seed)
    allowed = allowed_by(setup.motion_limits(), setup.tcp_offset)
    return plan_pool(request.images, setup.scene, setup.extent, request.seed, allowed)


def recorded_request(path: str | os.PathLike[str]) -> AcquisitionRequest:
    """How the acquisition of a recording was asked for; the file is not trusted.

    Raises:
        InputError: not an acquisition's recording; one line that starts with the path.
    """
    settings = settings_of(path)
    with naming(path):
        return request_in(settings)


def request_in(settings: dict[str, object]) -> AcquisitionRequest:
    """How an acquisition was asked for, from the settings in its recording.

    Raises:
        InputError: nothing that can be asked for.
    """
    asked = settings.get("request")
    try:
        if not isinstance(asked, dict):
            raise TypeError
        return AcquisitionRequest(**asked)
    except TypeError:
        raise InputError("has no settings of an acquisition to resume") from None
