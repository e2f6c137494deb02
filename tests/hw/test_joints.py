"""The controller's joints on their way to the gate, through real sockets and processes."""

from __future__ import annotations

import numpy as np
import pytest
from robots import CB_SERIES, E_SERIES, EmulatedRobot
from waiting import until

from hw.bench.robot import model_of
from hw.robot.kinematics import MODELS, forward, tool_of
from hw.robot.stream import PoseStream
from hw.runtime.rigid import ur_to_pose

OFFSET = (0.0, 0.0, 0.1, 0.0, 0.0, 0.0)


@pytest.mark.parametrize("version", [CB_SERIES, E_SERIES])
def test_the_stream_tells_joints_that_fit_the_pose(version):
    with (
        EmulatedRobot(version=version) as robot,
        PoseStream(robot.host, clock=robot.clock) as poses,
    ):
        samples = until(poses.drain)
    model = MODELS[model_of(version)]
    joints = samples[-1].joints
    assert joints is not None
    found = forward(model, np.array(joints)) @ tool_of(OFFSET)
    np.testing.assert_allclose(found, ur_to_pose(np.array(samples[-1].raw)), atol=1e-6)
