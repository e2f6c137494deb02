"""The robot: where its tool is, what it may do, and how it is asked to move.

``stream`` reads poses. ``limits``, ``motion_plan`` and ``confirmation``
say what may be commanded; ``path_checks``, ``feasibility`` and ``gate`` check it. ``motion`` asks
for a move, and ``mover`` is the process that commands the robot.
"""
