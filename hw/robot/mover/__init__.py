"""The process that moves the robot, for :class:`hw.robot.motion.Motion`.

It is started as ``hw.robot.mover`` and holds the only control connection and the gate. One loop
reads the poses, checks for trouble, kicks the controller's watchdog and takes requests, one JSON
object a line, from its standard input. The loop never waits for a motion: motions are asynchronous,
so that every pose is checked while the robot moves. When the input ends (the caller is gone), the
robot is stopped.

- ``messages``: what the caller and this process tell each other; the caller imports it, too.
- ``inputs``: everything that comes in (requests, packets, what ur_rtde prints), and the latch of a
  stop, which stays until the robot rests, or for good.
- ``controller``: the only commands to the robot, the watchdog's kicks, and braking.
- ``connection``: opening and ending the connection to the controller.
- ``program``: what runs on the controller meanwhile, and its own watchdog.
- ``monitor``: what must stop the robot.
- ``control_loop``: requests become motions, one after the other; its states.
- ``__main__``: the process.
"""
