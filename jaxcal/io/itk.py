"""ITK transforms, which Slicer loads: ``.tfm`` and ``.txt`` (text) and ``.h5``.

ITK stores a transform "from parent", in LPS. Slicer shows it "to parent", in RAS. With
L = diag(-1, -1, 1, 1), the matrix M that takes Image to Probe in Slicer's own coordinates is stored
as A = L inverse(M) L. Poses in sequences and OpenIGTLink messages are *not* changed like that.
"""

from __future__ import annotations

import io
import os
from pathlib import Path

import h5py
import numpy as np

from jaxcal import FormatError, InputError
from jaxcal.data.poses import (
    check_affine,
    matrices_from_rotations,
    rotations_from_quaternions,
    rotations_from_vectors,
)
from jaxcal.io.atomic import write_bytes, write_text
from jaxcal.io.given_files import check_readable, naming
from jaxcal.io.lines import text_lines
from jaxcal.io.untrusted import Node, UpTo, array, child, group, open_root, string
from jaxcal.runtime.array_types import Float
from jaxcal.runtime.messages import quoted

_LPS = np.diag([-1.0, -1.0, 1.0, 1.0])
_KIND = "AffineTransform_double_3_3"
_HEAD = "#Insight Transform File V1.0"
_FIELDS = ("Transform", "Parameters", "FixedParameters")
_AFFINE = ("AffineTransform", "MatrixOffsetTransformBase")


def itk_from_matrix(matrix: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, " 12"]:
    """ITK's parameters of a matrix: A row by row, then the translation."""
    # Adding zero makes 0 of -0.
    stored = _LPS @ np.linalg.inv(check_affine(matrix)) @ _LPS + 0.0
    return np.concatenate([stored[:3, :3].ravel(), stored[:3, 3]])


def matrix_from_itk(
    kind: str, parameters: np.ndarray, fixed: np.ndarray
) -> Float[np.ndarray, "4 4"]:
    """The matrix "to parent" in RAS of an ITK transform.

    Args:
        kind: ITK's name, for instance ``AffineTransform_double_3_3``.
        parameters: 12 for an affine transform; 6 for Euler3DTransform (angles, translation) and
            VersorRigid3DTransform (versor, translation).
        fixed: centre of rotation c; the offset is t + c - A c.

    Raises:
        FormatError: another kind, or parameters that do not belong to the kind.
    """
    name = kind.split("_")[0]
    parameters, fixed = np.asarray(parameters, float), np.asarray(fixed, float)
    if not (np.isfinite(parameters).all() and np.isfinite(fixed).all()):
        raise FormatError("the transform holds NaN or Inf")
    if name in _AFFINE and len(parameters) == 12:
        linear, translation = parameters[:9].reshape(3, 3), parameters[9:]
    elif name == "Euler3DTransform" and len(parameters) == 6:
        linear, translation = _euler(parameters[:3], fixed), parameters[3:]
    elif name == "VersorRigid3DTransform" and len(parameters) == 6:
        linear, translation = _versor(parameters[:3]), parameters[3:]
    else:
        raise FormatError(
            f"{quoted(kind)} with {len(parameters)} parameters is not read: an affine, an Euler3D "
            "or a VersorRigid3D transform is"
        )
    centre = fixed[:3] if len(fixed) >= 3 else np.zeros(3)
    stored = matrices_from_rotations(linear, translation + centre - linear @ centre)
    if abs(np.linalg.det(linear)) < 1e-15:
        raise FormatError("the transform is singular")
    return _LPS @ np.linalg.inv(stored) @ _LPS + 0.0


def _euler(angles: np.ndarray, fixed: np.ndarray) -> Float[np.ndarray, "3 3"]:
    x, y, z = rotations_from_vectors(np.diag(angles))
    # A fourth fixed parameter says that the order is ZYX.
    zyx = len(fixed) > 3 and fixed[3] != 0
    return z @ y @ x if zyx else z @ x @ y


def _versor(vector: np.ndarray) -> Float[np.ndarray, "3 3"]:
    squared = vector @ vector
    if squared > 1 + 1e-9:
        raise FormatError("a versor longer than 1")
    scalar = np.sqrt(max(0.0, 1 - squared))
    return rotations_from_quaternions(np.array([[*vector, scalar]]), "xyzw")[0]


def itk_text(matrix: Float[np.ndarray, "4 4"]) -> str:
    """The text of a ``.tfm`` file that Slicer shows as this matrix (RAS, "to parent")."""
    numbers = " ".join(map(repr, itk_from_matrix(matrix).tolist()))
    return (
        f"{_HEAD}\n#Transform 0\nTransform: {_KIND}\nParameters: {numbers}\n"
        "FixedParameters: 0 0 0\n"
    )


def write_itk(path: str | os.PathLike[str], matrix: Float[np.ndarray, "4 4"]) -> None:
    """Write a transform as ``.tfm``, ``.txt`` or ``.h5``, complete or not at all.

    Raises:
        InputError: another extension, or a matrix that is no proper affine transform.
        OutputError: it could not be written.
    """
    name = os.fspath(path)
    extension = Path(name).suffix.lower()
    if extension in (".tfm", ".txt"):
        write_text(path, itk_text(matrix))
        return
    if extension != ".h5":
        raise InputError(f"{name}: an ITK transform's name ends in .tfm, .txt or .h5")
    parameters = itk_from_matrix(matrix)
    # ITK cannot read h5py's default character set, UTF-8.
    ascii_text = h5py.string_dtype("ascii")
    # Built in memory: HDF5 crashes on a full disk.
    content = io.BytesIO()
    with h5py.File(content, "w") as file:
        for key, value in (
            ("ITKVersion", "5.4.0"),
            ("HDFVersion", h5py.version.hdf5_version),
            ("OSName", "any"),
            ("OSVersion", "any"),
            ("TransformGroup/0/TransformType", _KIND),
        ):
            file.create_dataset(key, data=[value], dtype=ascii_text)
        file["TransformGroup/0/TransformParameters"] = parameters
        file["TransformGroup/0/TransformFixedParameters"] = np.zeros(3)
    write_bytes(path, content.getvalue())


def read_itk(path: str | os.PathLike[str]) -> Float[np.ndarray, "4 4"]:
    """The matrix ("to parent", RAS) of an ITK transform file; the file is not trusted.

    Raises:
        FormatError: not such a file, more than one transform, or another kind of transform.
    """
    check_readable(path)
    with naming(path):
        if Path(path).suffix.lower() == ".h5":
            with open_root(path) as root:
                return matrix_from_itk(*_read_hdf5(root))
        return matrix_from_itk(*_read_text(path))


def _read_text(path: str | os.PathLike[str]) -> tuple[str, np.ndarray, np.ndarray]:
    fields: dict[str, str] = {}
    first = True
    for line, content in text_lines(path, comments=True):
        if first and not content.startswith(_HEAD):
            raise FormatError("is not an ITK transform: its first line does not say so")
        first = False
        if content.startswith("#"):
            continue
        key, _, value = content.partition(":")
        if key not in _FIELDS:
            continue
        if key in fields:
            raise FormatError(f"line {line}: a second {quoted(key)}; one transform is read")
        fields[key] = value.strip()
    if "Transform" not in fields or "Parameters" not in fields:
        raise FormatError("holds no transform")
    try:
        numbers = [
            np.array([float(part) for part in fields.get(key, "").split()])
            for key in ("Parameters", "FixedParameters")
        ]
    except ValueError:
        raise FormatError("its parameters are not numbers") from None
    return fields["Transform"], numbers[0], numbers[1]


def _read_hdf5(root: Node) -> tuple[str, np.ndarray, np.ndarray]:
    transforms = group(root, "TransformGroup")
    if transforms is None:
        if child(root, "calibration") is not None:
            raise FormatError("is a recording: calibrate it first (jaxcal calibrate)")
        raise FormatError("is not an ITK transform: /TransformGroup is missing")
    if child(transforms, "1") is not None:
        raise FormatError("holds several transforms; it must hold only one")
    one = group(transforms, "0")
    if one is None:
        raise FormatError("holds no transform")
    kind = child(one, "TransformType")
    # Before version 5 ITK wrote "Tranform".
    parameters = child(one, "TransformParameters") or child(one, "TranformParameters")
    fixed = child(one, "TransformFixedParameters") or child(one, "TranformFixedParameters")
    if parameters is None or fixed is None or kind is None:
        raise FormatError(f"{one} is incomplete")
    some = (UpTo(99, "numbers"),)
    return string(kind), array(parameters, some), array(fixed, some)
