"""The meaning of a table's columns, by the names in its header.

Names are compared without case, blanks and underscores. A unit may stand in brackets or behind an
underscore: ``tx [mm]``, ``time (ms)``, ``u_px``. Of a path in a ROS message (``pose.position.x``,
``/pose/orientation/w``) the last two names count.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from jaxcal import FormatError
from jaxcal.data.names import QuaternionOrder
from jaxcal.runtime.messages import enumerated, quoted

LENGTHS_MM: dict[str, float] = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "in": 25.4}
TIMES_S = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}

_NAMES = {
    "time": ("time", "t", "timestamp", "timestamps", "stamp", "seconds"),
    "nanoseconds": ("nanosec",),
    "frame": ("frame", "framenumber", "frameindex", "index", "image", "imagenumber"),
    "file": ("file", "filename", "imagefile", "png"),
    "ignored": ("name", "label", "comment"),
    "valid": ("valid", "status", "state", "ok", "used"),
    "u": ("u", "column", "col", "pixelu", "pixelx"),
    "v": ("v", "row", "pixelv", "pixely"),
    "lateral": ("lateral",),
    "range": ("range", "axial", "depth"),
    "x": ("x", "tx", "px", "posx", "positionx", "translationx"),
    "y": ("y", "ty", "py", "posy", "positiony", "translationy"),
    "z": ("z", "tz", "pz", "posz", "positionz", "translationz"),
    "qx": ("qx", "rx", "rotx", "quatx", "quaternionx", "rotationx", "orientationx"),
    "qy": ("qy", "ry", "roty", "quaty", "quaterniony", "rotationy", "orientationy"),
    "qz": ("qz", "rz", "rotz", "quatz", "quaternionz", "rotationz", "orientationz"),
    "qw": ("qw", "rw", "rotw", "qs", "quatw", "quaternionw", "rotationw", "orientationw", "w"),
}
_ROLE = {name: role for role, names in _NAMES.items() for name in names}
_UNIT = re.compile(
    r"^(.*?)(?:\s*[\[(]\s*([^\])]*?)\s*[\])]|[_\s](mm|cm|m|in|px|pixels?|s|ms|us|ns))?$"
)
_OF_MESSAGE = re.compile(r".*[./]((?:position|translation|orientation|rotation)[./][xyzw])")
"""A part of a ROS message by its path, as ``pose.position.x``, without what stands before it."""
_OF_HEADER = re.compile(
    r"(?P<field>field\.)?(?:.*\.)?"
    r"(?:header\.(?P<part>seq|stamp|stamp\.secs|stamp\.nsecs|frame_id)|(?P<child>child_frame_id))"
)
"""A part of a ROS message's header, or the name of its frame. ``rostopic echo -p`` writes
``field.`` before it and the stamp in ns, bagpy the stamp as two numbers."""
_STAMPS = {"stamp": ("time", "ns"), "stamp.secs": ("time", "s"), "stamp.nsecs": ("nanosec", "ns")}
"""Name and unit of a header's parts that are read."""
_CELL = re.compile(r"([a-z]*?)_?([0-4])[_,]?([0-4])")
_NUMBERED = re.compile(r"([a-z]*?)_?(\d{1,2})")
_OTHER_ROTATION = re.compile(
    r"(?:r(?:ot|otvec)?[xyz]|roll|pitch|yaw)(?:deg|rad)?|actualtcppose[0-5]"
)
CONVERT = (
    "rotation vectors, as robots of Universal Robots log them, and Euler angles are not read: "
    "convert them to quaternions (docs/how-to/robot.md shows how)"
)
"""What to do about a pose of six numbers."""
SPELLINGS = {
    "mm": ("millimeter", "millimeters", "millimetre", "millimetres"),
    "cm": (),
    "in": ("inch", "inches"),
    "m": ("meter", "meters", "metre", "metres"),
    "px": ("pixel", "pixels"),
    "s": ("sec", "second", "seconds"),
    "ms": (),
    # The micro sign, and the Greek letter that looks like it.
    "us": ("\u00b5s", "\u03bcs"),
    "ns": (),
}
"""Units as other programs write them."""
_UNITS = {name: unit for unit, others in SPELLINGS.items() for name in (unit, *others)}


@dataclass(frozen=True)
class Columns:
    """Which columns of a row hold what; column numbers count from 0.

    Attributes:
        matrix: 12 or 16 columns of a pose, row by row; None without.
        translation: 3 columns beside a quaternion; None without.
        quaternion: 4 columns, x y z w; None without.
        point: 2 columns, u v or lateral range; None without.
        time: s.
        nanoseconds: what is to be added to the time, ns.
        frame: number of an image.
        file: name of an image's file.
        valid: whether a row counts.
        length_mm: one unit of translations in mm.
        point_unit: ``px`` or a unit of length; None where the header does not say.
        time_s: one unit of time in s; None where the header does not say.
        not_read: names of columns of a ROS message that are not read.
    """

    matrix: tuple[int, ...] | None = None
    translation: tuple[int, ...] | None = None
    quaternion: tuple[int, ...] | None = None
    point: tuple[int, ...] | None = None
    time: int | None = None
    nanoseconds: int | None = None
    frame: int | None = None
    file: int | None = None
    valid: int | None = None
    length_mm: float | None = None
    point_unit: str | None = None
    time_s: float | None = None
    not_read: tuple[str, ...] = ()


def _is_numbered(base: str) -> bool:
    """Whether a name may be that of a cell of a matrix, or of one of several numbers."""
    return bool(_CELL.fullmatch(base) or _NUMBERED.fullmatch(base))


def names_columns(cells: list[str]) -> bool:
    """Whether most of the cells are names of columns, rather than words of a sentence."""
    bases = [_split(cell)[0] for cell in cells]
    known = [base for base in bases if base in _ROLE or _is_numbered(base)]
    return 2 * len(known) > len(cells)


def columns_of_header(names: list[str], quaternion: QuaternionOrder | None) -> Columns:
    """The columns that a header names.

    ``quaternion`` is the order of columns that are only numbered (q1 to q4, q0 to q3); it must not
    contradict names.

    Raises:
        FormatError: a name that is not known, twice, or missing beside others; units that differ.
    """
    scalar = any(_split(name)[0] in ("rw", "rotw") for name in names)
    for index, name in enumerate(names):
        if not scalar and _OTHER_ROTATION.fullmatch(_split(name)[0]):
            raise FormatError(f"the header's column {index + 1}, {quoted(name)}: {CONVERT}")
    bases, units = zip(*(_base_and_unit(name) for name in names), strict=True)
    not_read = _not_read(names)
    roles: dict[str, int] = {}
    rest: list[int] = []
    numbered = [(int(base[1]), k) for k, base in enumerate(bases) if re.fullmatch("q[0-4]", base)]
    for index, base in enumerate(bases):
        role = _ROLE.get(base)
        if base == "q0" and len(numbered) == 1:
            role = "qw"
        # pandas and R write the numbers of the rows as a first column without a name.
        if role == "ignored" or index in not_read or (index == 0 and not base):
            continue
        if role is None:
            rest.append(index)
        elif role in roles:
            raise FormatError(
                f"columns {roles[role] + 1} and {index + 1} are both {role}: "
                f"{quoted(names[roles[role]])} and {quoted(names[index])}"
            )
        else:
            roles[role] = index
    strange = [k for k in rest if not _is_numbered(bases[k])]
    if "slice" in bases:
        raise FormatError(
            f"the header's column {bases.index('slice') + 1}, "
            f"{quoted(names[bases.index('slice')])}, is not known: ImageJ and Fiji count slices "
            "from 1, frames count from 0. Take 1 from each slice, and name the columns frame, u "
            "and v (X and Y in pixels)"
        )
    if strange:
        cells = {*rest} - {*strange} - {column for _, column in numbered}
        if len(cells) not in (9, 12, 16):  # they are no matrix, either
            strange = sorted({*strange, *cells})
        raise _unknown(names, strange)
    quaternion_columns = _quaternion(roles, numbered, quaternion)
    rest = [index for index in rest if index not in (quaternion_columns or ())]
    translation = _complete(roles, ("x", "y", "z"), "x, y and z")
    matrix = _matrix(rest, list(bases), translation)
    if rest and matrix is None:
        others = [index for index in rest if not re.fullmatch("m[1-3][1-4]", bases[index])]
        raise _unknown(names, others or rest)
    if matrix is not None and translation is not None and len(rest) != 9:
        raise FormatError("the header names both a whole matrix and x, y, z")
    if (quaternion_columns is None) != (translation is None) and matrix is None:
        raise FormatError("the header needs x, y, z and a quaternion together")
    if matrix is not None and quaternion_columns is not None:
        raise FormatError("the header names both a matrix and a quaternion")
    point, point_unit = _point(roles, list(units))
    lengths = translation or (matrix[3:12:4] if matrix else ())
    if "nanoseconds" in roles and "time" not in roles:
        raise FormatError("the header has nanoseconds of a time, but not its seconds")
    time_unit = None if "time" not in roles else units[roles["time"]]
    if time_unit not in (None, *TIMES_S):
        raise FormatError(f"time in {quoted(str(time_unit))} is not known: s, ms, us or ns")
    return Columns(
        matrix=matrix,
        translation=None if matrix is not None else translation,
        quaternion=quaternion_columns,
        point=point,
        time=roles.get("time"),
        nanoseconds=roles.get("nanoseconds"),
        frame=roles.get("frame"),
        file=roles.get("file"),
        valid=roles.get("valid"),
        length_mm=_length(lengths, names, list(units)),
        point_unit=point_unit,
        time_s=None if time_unit is None else TIMES_S[time_unit],
        not_read=tuple(names[index] for index in not_read),
    )


def _not_read(names: list[str]) -> list[int]:
    """Columns of a ROS message that are neither a pose nor the time of its measurement.

    The first one, ``%time`` of ``rostopic echo -p`` and ``Time`` of bagpy, is the time of the
    recording where the message comes from a bag.
    """
    parts = [_header_part(name) for name in names]
    of_bag = {"%time"} if "stamp" in parts else {"time"} if "stamp.secs" in parts else set()
    return [
        index
        for index, (name, part) in enumerate(zip(names, parts, strict=True))
        if (part is not None and part not in _STAMPS) or name.strip().lower() in of_bag
    ]


def _header_part(name: str) -> str | None:
    """The part of a ROS message's header, if a column is one."""
    found = _OF_HEADER.fullmatch(name.strip().lower())
    # Without "field." nothing says in what unit a stamp is that is one number.
    if found is None or (found["part"] == "stamp" and not found["field"]):
        return None
    return found["part"] or found["child"]


def _unknown(names: list[str], columns: list[int]) -> FormatError:
    first = f" {columns[0] + 1}, {quoted(names[columns[0]])}, is"
    listed = enumerated([f"{each + 1} ({quoted(names[each])})" for each in columns])
    which = first if len(columns) == 1 else f"s {listed} are"
    return FormatError(
        f"the header's column{which} not known: name the columns time, frame, u, v, x, y, z, qx, "
        "qy, qz, qw or m11 to m34 (comment: all that are not to be read), or leave the header out"
    )


def _split(name: str) -> tuple[str, str | None]:
    found = _UNIT.match(name.strip().lower())
    assert found is not None
    base = _OF_MESSAGE.sub(r"\1", found[1])
    return re.sub(r"[\s_./]+", "", base), found[2] or found[3]


def _base_and_unit(name: str) -> tuple[str, str | None]:
    if (stamp := _STAMPS.get(_header_part(name) or "")) is not None:
        return stamp
    base, unit = _split(name)
    if base == "seconds" and unit is None:
        unit = "s"
    if base == "%time" and unit is None:
        # As "rostopic echo -p" writes it.
        base, unit = "time", "ns"
    if unit is None or unit in _UNITS:
        return base, None if unit is None else _UNITS[unit]
    if _is_numbered(base) or _ROLE.get(base, "ignored") != "ignored":
        raise FormatError(f"the unit of {quoted(name)} is not known")
    return base, None


def _complete(roles: dict[str, int], names: tuple[str, ...], what: str) -> tuple[int, ...] | None:
    present = [name for name in names if name in roles]
    if not present:
        return None
    if len(present) < len(names):
        hint = " (points in the image are named u and v)" if present == ["x", "y"] else ""
        raise FormatError(f"the header has {', '.join(present)} but not all of {what}{hint}")
    return tuple(roles[name] for name in names)


def _quaternion(
    roles: dict[str, int], numbered: list[tuple[int, int]], order: QuaternionOrder | None
) -> tuple[int, ...] | None:
    """Columns of x, y, z, w; None without. ``numbered`` are numbers and columns of q0 to q4."""
    if len(numbered) == 4:
        where = dict(numbered)
        if order is None:
            raise FormatError(
                "the quaternion's columns are only numbered: say whether the scalar comes first or "
                "last (--quaternion wxyz or xyzw)"
            )
        # Columns may stand in any order: their numbers count.
        columns = [where[number] for number in sorted(where)]
        if sorted(where) not in ([0, 1, 2, 3], [1, 2, 3, 4]):
            raise FormatError("the quaternion's columns must be numbered q0 to q3, or q1 to q4")
        return (*columns[1:], columns[0]) if order == "wxyz" else tuple(columns)
    columns = _complete(roles, ("qx", "qy", "qz", "qw"), "qx, qy, qz and qw")
    if columns is not None and order is not None:
        named = "".join(part for _, part in sorted(zip(columns, "xyzw", strict=True)))
        if named != order:
            raise FormatError(
                f"the header says that the quaternion's numbers are {' '.join(named)}, and "
                f"--quaternion says {order}: correct the header, or leave the option out"
            )
    return columns


def _matrix(
    rest: list[int], bases: list[str], translation: tuple[int, ...] | None
) -> tuple[int, ...] | None:
    """Columns of a matrix row by row; None where these are not those of one."""
    cells = [_CELL.fullmatch(bases[index]) for index in rest]
    found = [cell for cell in cells if cell is not None]
    if len(found) == len(rest) and len(rest) in (9, 12, 16):
        places = [(int(cell[2]), int(cell[3])) for cell in found]
        first = min(min(place) for place in places)
        where = {
            (row - first, column - first): index
            for (row, column), index in zip(places, rest, strict=True)
        }
        if translation is not None and len(rest) == 9:
            where |= {(row, 3): index for row, index in enumerate(translation)}
        rows = 4 if len(where) == 16 else 3
        wanted = [(row, column) for row in range(rows) for column in range(4)]
        if set(where) == set(wanted):
            return tuple(where[place] for place in wanted)
    numbers = [_NUMBERED.fullmatch(bases[index]) for index in rest]
    if all(numbers) and len(rest) in (12, 16):
        values = [int(number[2]) for number in numbers if number is not None]
        if values in (list(range(len(rest))), list(range(1, len(rest) + 1))):
            return tuple(rest)
    return None


def _point(
    roles: dict[str, int], units: list[str | None]
) -> tuple[tuple[int, ...] | None, str | None]:
    pixels = _complete(roles, ("u", "v"), "u and v")
    lengths = _complete(roles, ("lateral", "range"), "lateral and range")
    if pixels is not None and lengths is not None:
        raise FormatError("the header names both u, v and lateral, range")
    point = pixels or lengths
    if point is None:
        return None, None
    stated = {units[index] for index in point}
    if len(stated) > 1:
        raise FormatError("the two coordinates of a point are in different units")
    unit = stated.pop()
    if unit not in (None, "px", *LENGTHS_MM):
        raise FormatError(f"points in {quoted(str(unit))} are not known")
    return point, unit or ("mm" if lengths is not None else None)


def _length(columns: tuple[int, ...], names: list[str], units: list[str | None]) -> float | None:
    stated = {units[index] for index in columns}
    if len(stated) > 1:
        mixed = ", ".join(quoted(names[index]) for index in columns)
        raise FormatError(f"translations are in different units: {mixed}")
    unit = stated.pop() if stated else None
    if unit not in (None, *LENGTHS_MM):
        raise FormatError(f"translations in {quoted(str(unit))} are not known: mm, cm, m or in")
    return None if unit is None else LENGTHS_MM[unit]
