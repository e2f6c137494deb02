"""Draw all drawings of the documentation: ``python docs/drawings/draw.py``.

Each function is one drawing and writes the SVG of its name beside this file.
"""

from __future__ import annotations

import itertools
import math
from pathlib import Path

import numpy as np
from canvas import Canvas, Point

HERE = Path(__file__).parent


def _beam(canvas: Canvas, x: float, top: float, bottom: float) -> None:
    """A beam seen along the lateral axis: it narrows to its focus, and opens again."""
    depth = np.linspace(0, 1, 40)
    half = 14 + 14 * (depth - 0.45) ** 2 / 0.3
    down = [(x - h, top + d * (bottom - top)) for h, d in zip(half, depth, strict=True)]
    up = [(x + h, top + d * (bottom - top)) for h, d in zip(half, depth, strict=True)]
    canvas.polygon(down + up[::-1], "wash-blue")
    canvas.line([(x, top), (x, bottom)], "thin blue dash")


def _probe(canvas: Canvas, x: float, face: float) -> None:
    """A probe seen from its narrow side; its face is at the given height."""
    canvas.path(
        f"M{x - 22},{face - 62} L{x - 22},{face - 30} L{x - 14},{face - 10} L{x - 14},{face} "
        f"L{x + 14},{face} L{x + 14},{face - 10} L{x + 22},{face - 30} L{x + 22},{face - 62} Z",
        "wash-grey line ink",
    )


def idea() -> Canvas:
    """What everybody assumes, and what happens."""
    canvas = Canvas(740, 430, "The target is seen though it lies out of the image plane")
    face, bottom = 128.0, 320.0
    canvas.text((28, 40), "Usually assumed", "head")
    canvas.text((250, 40), "What happens, image by image", "head")
    canvas.line([(226, 26), (226, 404)], "thin grey")

    _beam(canvas, 112, face, bottom)
    _probe(canvas, 112, face)
    canvas.circle((112, 250), 7, "fill-ink")
    canvas.line([(120, 254), (144, 268)], "thin grey")
    canvas.text((148, 276), "target", "soft")
    canvas.lines((28, 358), "It lies in the image\nplane of every image.", step=22)

    offsets = (14.0, -15.0, 8.0)
    for k, (x, y, depth) in enumerate(zip((318, 456, 594), offsets, (250, 206, 268), strict=True)):
        _beam(canvas, x, face, bottom)
        _probe(canvas, x, face)
        canvas.circle((x + y, depth), 7, "fill-orange")
        canvas.line([(x + y, depth + 13), (x + y, depth + 34)], "thin orange")
        canvas.line([(x, depth + 13), (x, depth + 34)], "thin orange")
        canvas.line([(x, depth + 27), (x + y, depth + 27)], "line orange")
        side = 1 if y > 0 else -1
        canvas.text(
            (x + y + side * 20, depth + 32),
            "y" + "₁₂₃"[k],
            "math fill-orange",
            "start" if side > 0 else "end",
        )
    canvas.lines((640, 150), "the beam,\nseen from\nits side", step=20)
    canvas.lines(
        (250, 358),
        "The beam is millimetres thick: a target beside the\n"
        "plane is seen as well. jaxcal estimates every offset\n"
        "together with the calibration.",
        step=22,
    )
    return canvas


def frames() -> Canvas:
    """Tracker, probe, image, target, and the transforms between them."""
    canvas = Canvas(720, 560, "Frames: image, probe and tracker, and the transforms between them")

    # The tracker is a camera.
    canvas.text((28, 40), "tracker or robot base", "head")
    canvas.box((40, 62), (140, 40), "wash-grey line ink", 12)
    canvas.circle((68, 82), 11, "paper line ink")
    canvas.circle((152, 82), 11, "paper line ink")
    tracker = (110.0, 146.0)
    canvas.line([(110, 102), tracker], "thin grey dash")
    canvas.axes(
        tracker,
        {"x": ((56, 0), (70, 6)), "z": ((0, 56), (-14, 60)), "y": ((-34, 28), (-46, 40))},
        "ink",
    )

    # The probe carries markers.
    canvas.text((338, 40), "probe: its markers or the flange", "head")
    canvas.path(
        "M352,66 L396,66 L396,126 L430,160 L430,190 L318,190 L318,160 L352,126 Z",
        "wash-grey line ink",
    )
    canvas.line([(396, 92), (462, 92)], "line ink")
    for marker in ((470, 66), (500, 92), (470, 118)):
        canvas.line([(462, 92), marker], "line ink")
        canvas.circle(marker, 7, "paper line ink")
    canvas.axes(
        (374.0, 152.0),
        {"x": ((36, 14), (30, 32)), "y": ((0, -40), (12, -32)), "z": ((-36, 18), (-46, 16))},
        "green",
    )

    # The image plane begins at the face.
    canvas.polygon([(318, 192), (430, 192), (430, 420), (318, 420)], "wash-blue")
    canvas.line([(318, 192), (318, 420), (430, 420), (430, 192)], "thin blue")
    image = (374.0, 194.0)
    canvas.axes(
        image,
        {"x": ((92, 0), (106, 6)), "z": ((0, 100), (-14, 106)), "y": ((-44, 38), (-54, 58))},
        "blue",
    )
    canvas.text((450, 236), "image", "head")
    canvas.lines(
        (450, 262),
        "x lateral, along the elements\n"
        "z axial, away from the face\n"
        "y = z × x elevational, out of\n"
        "the plane, here towards you",
        step=22,
    )

    target = (400.0, 372.0)
    canvas.circle(target, 7, "fill-orange")
    canvas.arrow((image[0] + 1, image[1] + 4), (target[0] - 2, target[1] - 9), "orange", thin=True)
    canvas.text((408, 356), "q", "math fill-orange")
    canvas.line([(409, 376), (446, 388)], "thin grey")
    canvas.text((450, 394), "target at rest", "soft")

    canvas.curved_arrow((314, 214), (250, 160), (348, 116), "blue")
    canvas.text((276, 176), "X", "math fill-blue", "end")
    canvas.curved_arrow((346, 92), (250, 66), (172, 138), "green")
    canvas.text((242, 76), "Bᵢ", "math fill-green")
    canvas.curved_arrow((116, 152), (196, 380), (388, 376), "orange")
    canvas.text((190, 324), "c", "math fill-orange", "end")

    canvas.line([(28, 444), (692, 444)], "thin grey")
    canvas.lines(
        (28, 472),
        "Bᵢ: probe to tracker, measured by the tracker.   X: image to probe, the calibration.\n"
        "c: the target.   Every image says   c = Bᵢ X qᵢ.\n"
        "It shows the lateral position and the range of qᵢ, and not its offset y.",
        "text",
        step=26,
    )
    return canvas


def arrays() -> Canvas:
    """Where the image frame is, for a linear and a curvilinear array."""
    canvas = Canvas(720, 500, "The image frame of linear and curvilinear arrays")
    canvas.text((28, 40), "Linear", "head")
    canvas.text((314, 40), "Curvilinear", "head")
    canvas.line([(290, 26), (290, 474)], "thin grey")

    face = 190.0
    canvas.polygon([(42, face), (222, face), (222, 372), (42, 372)], "wash-blue")
    canvas.box((42, face - 18), (180, 18), "wash-grey line ink", 3)
    centre = (132.0, face)
    canvas.axes(centre, {"x": ((120, 0), (134, 6)), "z": ((0, 112), (-16, 112))}, "blue")
    canvas.line([(190, face + 2), (190, 310)], "thin orange dash")
    canvas.circle((190, 318), 6, "fill-orange")
    canvas.text((198, 262), "r", "math text")
    canvas.line([(132, 336), (190, 336)], "line orange")
    canvas.text((161, 358), "lateral", "soft", "middle")
    canvas.lines((28, 412), "Origin: the middle of\nthe element line.", step=22)

    scale, radius = 2.0, 60.0
    vertex = (530.0, 206.0)
    middle = (vertex[0], vertex[1] - scale * radius)
    half = math.radians(30.0)

    def at(angle: float, depth: float) -> Point:
        reach = scale * (radius + depth)
        return (middle[0] + reach * math.sin(angle), middle[1] + reach * math.cos(angle))

    arc = np.linspace(-half, half, 40)
    face_arc = [at(a, 0) for a in arc]
    canvas.polygon([*face_arc, *(at(a, 76) for a in arc[::-1])], "wash-blue")
    canvas.polygon([*face_arc, *(at(a, -9) for a in arc[::-1])], "wash-grey line ink")
    canvas.line([middle, at(-half, 0)], "thin grey dash")
    canvas.line([middle, at(half, 0)], "thin grey dash")
    canvas.axes(vertex, {"x": ((112, 0), (128, 6)), "z": ((0, 112), (-16, 112))}, "blue")
    canvas.circle(middle, 5, "fill-orange")
    canvas.lines((middle[0] + 16, middle[1] + 2), "centre of\ncurvature", step=20)
    canvas.arrow((336, middle[1]), (336, vertex[1]), "orange", thin=True, both=True)
    canvas.line([(330, middle[1]), (middle[0] - 9, middle[1])], "thin grey dash")
    canvas.line([(330, vertex[1]), (vertex[0] - 8, vertex[1])], "thin grey dash")
    canvas.lines((346, 142), "60 mm\n(radius)", step=20)
    canvas.text((vertex[0] - 14, vertex[1] + 30), "vertex", "soft", "end")
    angle = math.radians(17)
    canvas.line([at(angle, 1), at(angle, 48)], "thin orange dash")
    canvas.circle(at(angle, 52), 6, "fill-orange")
    canvas.lines(
        (314, 412),
        "Origin: the vertex of the arc, called “apex” here.\n"
        "Elsewhere “apex” is the centre of curvature,\n"
        "a radius behind it.",
        step=22,
    )
    return canvas


def offset() -> Canvas:
    """The circle on which a target of known lateral position and range lies."""
    canvas = Canvas(720, 430, "Lateral position and range leave the elevational offset open")
    # Seen along the lateral axis: elevational to the right, axial downwards.
    origin = (180.0, 100.0)
    reach = 220.0
    canvas.text((28, 40), "Seen along the lateral axis", "head")
    canvas.polygon(
        [
            (origin[0] - 15, origin[1]),
            (origin[0] + 15, origin[1]),
            (origin[0] + 54, 344),
            (origin[0] - 54, 344),
        ],
        "wash-blue",
    )
    canvas.box((origin[0] - 16, origin[1] - 36), (32, 36), "wash-grey line ink", 4)
    canvas.line([origin, (origin[0], 356)], "thin blue dash")
    arc = np.radians(np.linspace(-36, 36, 60))
    canvas.line(
        [(origin[0] + reach * math.sin(a), origin[1] + reach * math.cos(a)) for a in arc],
        "line orange",
    )
    angle = math.radians(12)
    target = (origin[0] + reach * math.sin(angle), origin[1] + reach * math.cos(angle))
    canvas.line([origin, target], "thin ink")
    canvas.text((origin[0] + 34, 222), "r", "math text")
    canvas.circle((origin[0], origin[1] + reach), 6, "paper line ink")
    canvas.text((origin[0] - 14, origin[1] + reach + 34), "p(0)", "math text", "end")
    canvas.circle(target, 7, "fill-orange")
    canvas.text((target[0] + 14, target[1] + 32), "p(y)", "math fill-orange")
    canvas.line([(origin[0], 372), (target[0], 372)], "line orange")
    canvas.line([(target[0], 364), (target[0], 380)], "thin orange")
    canvas.line([(origin[0], 364), (origin[0], 380)], "thin orange")
    canvas.text((0.5 * (origin[0] + target[0]), 402), "y", "math fill-orange", "middle")
    canvas.axes((52.0, 96.0), {"y": ((54, 0), (66, 6)), "z": ((0, 54), (-14, 58))}, "blue")

    canvas.text((372, 84), "An image shows", "head")
    canvas.lines(
        (372, 112), "the lateral position x and the range r.\nThe same for every point", step=23
    )
    canvas.text((386, 168), "p(y) = (x, y, √(r² − y²)).", "math text")
    canvas.text((372, 222), "It does not show", "head")
    canvas.lines(
        (372, 250),
        "the offset y. The depth hardly suffers:\n"
        "0.04 mm for 2 mm at 50 mm. But the\n"
        "point p(0) that is assumed is 2 mm\n"
        "beside the target.",
        step=23,
    )
    return canvas


def system() -> Canvas:
    """The arrow-shaped normal equations and what is left of them."""
    canvas = Canvas(720, 450, "The arrow-shaped system, and the small one that remains")
    canvas.text((28, 40), "Normal equations", "head")
    left, top, size, corner = 40.0, 62.0, 264.0, 72.0
    count = 12
    cell = (size - corner) / count
    canvas.box((left, top), (size, size), "thin grey", 2)
    canvas.box((left, top), (corner, corner), "wash-blue line blue", 2)
    canvas.text((left + corner / 2, top + 42), "9 × 9", "text", "middle")
    canvas.box((left + corner, top), (size - corner, corner), "wash-orange thin orange", 2)
    canvas.box((left, top + corner), (corner, size - corner), "wash-orange thin orange", 2)
    for k in range(count):
        along, down = left + corner + k * cell, top + corner + k * cell
        canvas.line([(along, top), (along, top + corner)], "thin orange")
        canvas.line([(left, down), (left + corner, down)], "thin orange")
        canvas.box((along + 1, down + 1), (cell - 2, cell - 2), "fill-orange", 2)
    canvas.text((left + corner / 2, top + size + 26), "X, c", "text", "middle")
    middle = left + corner + (size - corner) / 2
    canvas.text((middle, top + size + 26), "y₁ … yₙ", "text", "middle")
    canvas.text((left + size - 52, top + corner + 44), "zero", "soft", "middle")
    canvas.text((left + corner + 56, top + size - 26), "zero", "soft", "middle")

    canvas.arrow((330, 192), (420, 192), "ink")
    canvas.text((440, 40), "What is solved", "head")
    canvas.box((448, 156), (72, 72), "wash-blue line blue", 2)
    canvas.text((484, 198), "9 × 9", "text", "middle")
    canvas.lines(
        (538, 152),
        "eliminated while\nthe images are\npassed: O(n),\nnot O(n³)",
        step=22,
    )
    canvas.lines(
        (28, 386),
        "An offset belongs to one image: it meets X and c (bands) and itself (diagonal),\n"
        "and no other offset. Pixel scale, sound speed and delay enlarge the blue block.",
        step=24,
    )
    return canvas


def acquisition() -> Canvas:
    """The bench and what it does at every pose."""
    canvas = Canvas(720, 620, "Acquisition: the bench and its loop")
    canvas.text((28, 40), "The bench", "head")
    canvas.box((40, 300), (84, 26), "wash-grey line ink", 3)
    joints = [(82, 298), (82, 196), (150, 116), (250, 116)]
    for start, end in itertools.pairwise(joints):
        canvas.line([start, end], "line ink")
    for joint in joints[:-1]:
        canvas.circle(joint, 10, "wash-grey line ink")
    canvas.text((82, 350), "robot", "soft", "middle")
    canvas.path(
        "M238,116 L262,116 L262,164 L272,178 L272,202 L228,202 L228,178 L238,164 Z",
        "wash-grey line ink",
    )
    canvas.polygon([(230, 204), (270, 204), (270, 306), (230, 306)], "wash-blue")
    canvas.line([(166, 192), (166, 326), (336, 326), (336, 192)], "line ink")
    canvas.line([(168, 197), (226, 197)], "thin blue")
    canvas.line([(274, 197), (334, 197)], "thin blue")
    canvas.circle((250, 272), 7, "fill-orange")
    canvas.line([(250, 280), (250, 326)], "thin ink")
    canvas.lines((250, 350), "tank with the active\necho element", "soft", "middle", 20)

    devices = (
        ("robot controller", 84),
        ("ultrasound machine", 176),
        ("active echo electronics", 268),
    )
    for name, height in devices:
        canvas.box((408, height), (212, 44), "wash-grey line ink")
        canvas.text((514, height + 28), name, "text", "middle")
    canvas.line([(40, 313), (24, 313), (24, 62), (380, 62), (380, 106), (404, 106)], "thin grey")
    canvas.line([(262, 136), (372, 136), (372, 198), (404, 198)], "thin grey")
    canvas.line([(250, 310), (372, 310), (372, 290), (404, 290)], "thin orange")
    canvas.line([(624, 106), (652, 106), (652, 290), (624, 290)], "thin grey")
    canvas.line([(624, 198), (652, 198)], "thin grey")
    canvas.arrow((652, 198), (652, 392), "grey", thin=True)
    canvas.text((642, 350), "jaxcal-hw", "soft", "end")

    canvas.text((28, 420), "At every pose", "head")
    steps = (
        ("move", "if the gate\nallows it"),
        ("place", "the target in\nthe mid-plane"),
        ("record", "pose, times,\nimage, bound"),
        ("estimate", "X, and how\ncertain it is"),
    )
    for k, (name, words) in enumerate(steps):
        x = 28.0 + 170 * k
        canvas.box((x, 440), (150, 88), "wash-blue thin blue")
        canvas.text((x + 12, 464), name, "head")
        canvas.lines((x + 12, 488), words, "soft", step=21)
        if k + 1 < len(steps):
            canvas.arrow((x + 150, 484), (x + 170, 484), "blue", thin=True)
    canvas.lines(
        (28, 562),
        "Every image is on the disk before the robot moves on. A fault stops the robot,\n"
        "and the run can be resumed.",
        step=22,
    )
    return canvas


def main() -> None:
    """Write all drawings."""
    for drawing in (idea, frames, arrays, offset, system, acquisition):
        drawing().write(HERE / f"{drawing.__name__}.svg")


if __name__ == "__main__":
    main()
