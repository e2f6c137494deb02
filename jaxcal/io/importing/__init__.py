"""From other programs' files to a recording.

``sources`` recognises the files and has the options. ``tables`` are those with poses and points
(``two_tables``: one of each). ``sequences`` bring poses (``frame_poses``, ``poses_by_time``) and
points (``frame_points``, or ``target_search`` in the frames) together. ``noticed`` tells what may
spoil a calibration; ``imported`` is what comes of it; ``files`` is the way in.
"""
