"""The robot: where its tool is, what it may do, and how it is asked to move.

``pose`` converts units, ``stream`` reads poses, ``safety`` says what may be commanded, ``motion``
asks for it, and ``mover`` is the process that commands the robot.
"""
