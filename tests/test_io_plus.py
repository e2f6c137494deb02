"""PLUS's configurations and results: read, patched byte by byte, and refused as PLUS refuses."""

from __future__ import annotations

import datetime
import re
from xml.etree import ElementTree

import numpy as np
import pytest

from jaxcal import FormatError, InputError
from jaxcal.cli.main import main
from jaxcal.io.plus import (
    patch_configuration,
    patched_configuration,
    read_transform,
    transform_element,
    update_transform_command,
)
from jaxcal.io.xml import parse_xml

IMAGE = ("Image", "Probe")
MATRIX = np.array([
    [0.0026, 0.1382, -0.0036, 44.265], [0.1472, -0.0021, 0.0139, -31.186],
    [0.0144, -0.0037, -0.1424, 6.817], [0, 0, 0, 1],
])  # fmt: skip
MATRIX[:3, :3] /= 1 + 1e-16
DATE = datetime.datetime(2026, 11, 21, 21, 0)

OLD = '<Transform From="Image" To="Probe" Matrix="1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"/>'
OTHER = '<Transform From="StylusTip" To="Stylus" Matrix="1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"/>'


def configuration(
    *inside: str, newline: str = "\r\n", head: str = '<?xml version="1.0"?>'
) -> bytes:
    lines = [
        head,
        "<PlusConfiguration version='2.3'>",
        "\t<!-- of 2013: a > b, \"quoted\" <Transform From='Image' To='Probe'/> -->",
        "\t<DataCollection  StartupDelaySec = '1' ><Device Id='V' LocalTimeOffsetSec='-0.084' />",
        "\t</DataCollection>",
        "\t<CoordinateDefinitions>",
        *(f"\t  {line}" for line in inside),
        "\t</CoordinateDefinitions>",
        "</PlusConfiguration>",
        "",
    ]
    return newline.join(lines).encode()


VARIANTS = {
    "lf": configuration(OLD, OTHER, newline="\n"),
    "crlf": configuration(OLD, OTHER),
    "bom": b"\xef\xbb\xbf" + configuration(OLD, OTHER),
    "latin": configuration(OLD.replace("/>", " Date='M\xe4rz'/>"), head="<?xml version='1.0' "
                           "encoding='ISO-8859-1'?>").decode().encode("latin-1"),
    "single quotes": configuration(OLD.replace('"', "'")),
    "tabs in the matrix": configuration(OLD.replace("1 0 0 0", "1\t0\t0\t0")),
    "lines in the matrix": configuration(OLD.replace(" 0 1 0 0 ", "\r\n\t\t0 1 0 0\r\n ")),
    "end tag": configuration(OLD.replace("/>", "></Transform>")),
    "comment inside": configuration(OLD.replace("/>", "><!-- a /> b --></Transform >")),
    "greater than": configuration(OLD.replace("/>", " Date='a > b /> c'/>")),
    "blanks": configuration(OLD.replace(' From="', '\r\n   From = "')),
    "lower case": configuration(OLD.replace('"Image"', '"image"')),
    "inverse": configuration(OLD.replace('"Image" To="Probe"', '"Probe" To="Image"')),
    "persistent": configuration(OLD.replace("/>", ' Persistent="FALSE" Error="3" />')),
    "last": configuration(OTHER, OLD),
    "twice in a line": configuration(OTHER + OLD),
    "no element": configuration(OTHER),
    "empty": configuration(),
    "no definitions": configuration(OLD).replace(b"CoordinateDefinitions", b"Else"),
    "entities of XML": configuration(OTHER.replace("StylusTip", "A&amp;B"), OLD),
    "characters by number": configuration(OLD.replace("/>", " Comment='Ger&#228;t'/>"),
                                          head="<?xml version='1.0' encoding='US-ASCII'?>"),
    "another case": configuration(OLD.replace("Transform", "transform")),
    "error and date": configuration(OLD.replace("/>", ' Error="0.9" Date="021513_103745"/>')),
}  # fmt: skip


@pytest.mark.parametrize("name", VARIANTS)
def test_only_the_element_changes(name, tmp_path):
    old = VARIANTS[name]
    new, _ = patched_configuration(old, IMAGE, MATRIX, error_mm=0.5, date=DATE)
    (tmp_path / "c.xml").write_bytes(new)
    found = read_transform(tmp_path / "c.xml", *IMAGE)
    np.testing.assert_array_equal(found.matrix, MATRIX)
    assert found.error_mm == 0.5
    put = found_element(parse_xml(new))
    assert put.attributes["Date"] == "2026.11.21 21:00:00"
    there = b"<CoordinateDefinitions>" in old
    replaced = [element for element in transforms(old) if is_between(element)] if there else []
    if replaced:
        # By expat's own offsets: every byte before and after the element is as it was.
        assert new[: put.start] == old[: replaced[0].start]
        assert new[put.end :] == old[replaced[0].end :]
    else:
        # What was put in is one piece, and the rest is as it was.
        before = next(k for k in range(len(new)) if new[k : k + 1] != old[k : k + 1])
        assert old == new[:before] + new[before + len(new) - len(old) :]
    if b"\r\n" in old:
        assert b"\n" not in new.replace(b"\r\n", b"")
    # Done again, nothing changes.
    assert patched_configuration(new, IMAGE, MATRIX, error_mm=0.5, date=DATE)[0] == new


@pytest.mark.parametrize("mark", ['Status="INVALID"', 'Valid="false"', 'Status="MISSING"'])
def test_a_transform_that_is_not_valid(tmp_path, mark, capsys):
    path = tmp_path / "c.xml"
    path.write_bytes(configuration(OLD.replace("/>", f" {mark}/>")))
    assert main(["export", str(path), "--slicer", str(tmp_path / "x.tfm")]) == 2
    error = capsys.readouterr().err
    assert f"is marked as '{mark.split(chr(34))[1]}'" in error
    assert error.count("\n") == 1
    assert not (tmp_path / "x.tfm").exists()
    # Another transform's status is no matter; the marks of a good one are none.
    path.write_bytes(configuration(OTHER.replace("/>", f" {mark}/>"), OLD))
    assert read_transform(path).target == "Probe"
    path.write_bytes(configuration(OLD.replace("/>", ' Status="OK" Valid="TRUE"/>')))
    assert read_transform(path).target == "Probe"


def test_transforms_are_inverted_and_chained_as_plus_does(tmp_path):
    path, moved = tmp_path / "c.xml", np.eye(4)
    moved[:3, 3] = 1.0, -2.0, 3.0

    def put(source, target, matrix):
        numbers = " ".join(map(repr, matrix.ravel().tolist()))
        return f'<Transform From="{source}" To="{target}" Matrix="{numbers}" Error="0.5"/>'

    inverse = put("Probe", "Image", np.linalg.inv(MATRIX))
    chain = (
        put("Image", "Transducer", np.linalg.inv(moved) @ MATRIX),
        put("Transducer", "Probe", moved),
    )
    unknown = inverse.replace('Error="0.5"', 'Error="-1"')
    for elements, error_mm in (
        ((OTHER, inverse), 0.5),
        ((OTHER, unknown), None),
        (chain, None),
        (chain[::-1], None),
    ):
        path.write_bytes(configuration(*elements))
        found = read_transform(path)
        np.testing.assert_allclose(found.matrix, MATRIX, rtol=0, atol=1e-12)
        assert found[1:] == (error_mm, "Probe")
    # Where no way leads to the probe, the only frame that is reached is taken.
    path.write_bytes(configuration(chain[0]))
    assert read_transform(path).target == "Transducer"
    for elements in ((OLD, put("Image", "Probe", MATRIX)), (OLD, inverse), (*chain, chain[1])):
        path.write_bytes(configuration(*elements))
        with pytest.raises(FormatError, match=r"2 transforms between .* remove the others"):
            read_transform(path)


def transforms(content):
    (place,) = parse_xml(content).all("CoordinateDefinitions")
    return [each for each in place.children if each.tag in ("Transform", "transform")]


def is_between(element):
    names = {element.attributes["From"].capitalize(), element.attributes["To"]}
    return names == {"Image", "Probe"}


def found_element(root):
    return next(
        t for t in root.all("CoordinateDefinitions/Transform")
        if (t.attributes["From"], t.attributes["To"]) == IMAGE
    )  # fmt: skip


def test_other_attributes_are_kept():
    new, _ = patched_configuration(VARIANTS["persistent"], IMAGE, MATRIX)
    attributes = found_element(parse_xml(new)).attributes
    assert attributes["Persistent"] == "FALSE"
    assert "Error" not in attributes


@pytest.mark.parametrize("encoding", ["UTF-8", "ISO-8859-1", "windows-1252"])
def test_other_attributes_are_kept_in_every_encoding(encoding):
    element = OLD.replace("/>", " Comment='Ger\xe4t'/>")
    old = configuration(element, head=f'<?xml version="1.0" encoding="{encoding}"?>')
    new, _ = patched_configuration(old.decode().encode(encoding), IMAGE, MATRIX)
    assert found_element(parse_xml(new)).attributes["Comment"] == "Ger\xe4t"


def test_definitions_without_an_end_tag_get_one():
    old = configuration().replace(
        b"<CoordinateDefinitions>\r\n\t</CoordinateDefinitions>", b"<CoordinateDefinitions />"
    )
    new, _ = patched_configuration(old, IMAGE, MATRIX)
    before, after = old.split(b" />\r\n</Plus")
    assert new.startswith(before + b">\r\n")
    assert new.endswith(b"</CoordinateDefinitions>\r\n</Plus" + after)
    np.testing.assert_array_equal(
        np.array(found_element(parse_xml(new)).attributes["Matrix"].split(), float), MATRIX.ravel()
    )


@pytest.mark.parametrize(
    ("inside", "message"),
    [
        ([OLD, OLD], "lines 7 and 8: 2 transforms between Image and Probe"),
        ([OLD, OLD.replace('"Image" To="Probe"', '"Probe" To="Image"')], "2 transforms between"),
        (
            [OTHER.replace("StylusTip", "Image").replace('"Stylus"', '"X"'),
             OTHER.replace("StylusTip", "Probe").replace('"Stylus"', '"X"')],
            "Image to X (line 7), Probe to X (line 8); PLUS refuses a second path",
        ),
        ([OLD.replace(' From="Image"', "")], ":7: <Transform> has no From"),
    ],
)  # fmt: skip
def test_what_plus_refuses(inside, message, tmp_path):
    path = tmp_path / "c.xml"
    path.write_bytes(configuration(*inside))
    with pytest.raises(FormatError, match=re.escape(message)) as caught:
        patch_configuration(path, IMAGE, MATRIX)
    assert str(caught.value).startswith(str(path))
    assert path.read_bytes() == configuration(*inside)


BOMB = '<!DOCTYPE x [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;&a;">]>'


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (configuration(OLD, head=BOMB), "document types and entities are not read"),
        (configuration(OLD, head="<!DOCTYPE x SYSTEM 'file:///etc/passwd'>"), "are not read"),
        (configuration(OLD).decode().encode("utf-16"), "is UTF-16"),
        (b"<a>" * 100 + b"</a>" * 100, "nested more than"),
        (b"<PlusConfiguration>", "is not XML"),
        (b"<Other/>", "its root is 'Other'"),
        (
            configuration("<Transform From='A' To='B' Matrix='1 2 3'/>"),
            ":7: Matrix of <Transform> must have 16 numbers, not 3",
        ),
        (configuration(OLD.replace("1 0 0 0 0", "nan 0 0 0 0")), "<Transform> holds NaN"),
        (configuration(OLD.replace("1 0 0 0 0", "1 x 0 0 0")), "is not numbers"),
        (configuration(OLD.replace('0 0 0 1"', '0 0 1 1"')), "last row is not 0 0 0 1"),
    ],
)  # fmt: skip
def test_configuration_that_lies(content, message, tmp_path):
    (tmp_path / "c.xml").write_bytes(content)
    with pytest.raises(FormatError, match=re.escape(message)) as caught:
        read_transform(tmp_path / "c.xml")
    assert str(caught.value).startswith(str(tmp_path / "c.xml"))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (MATRIX @ np.diag([1, 1, -1, 1.0]), "is a reflection"),
        (np.full((4, 4), np.nan), "4 x 4 and finite"),
        (MATRIX.T, "last row is not 0 0 0 1"),
    ],
)
def test_matrices_that_plus_would_not_take(matrix, message):
    with pytest.raises(InputError, match=message):
        patched_configuration(configuration(OLD), IMAGE, matrix)


def test_stale_pixel_size_is_told():
    scaled = OTHER.replace("StylusTip", "TransducerOriginPixel").replace(
        '"Stylus"', '"TransducerOrigin"'
    )
    new, notes = patched_configuration(configuration(OLD, scaled), IMAGE, MATRIX)
    assert "still has pixels of 1 x 1 mm" in notes[0]
    # The line is that of the file as it is now: one line of ours has become five.
    line = int(notes[0].split(":")[0].removeprefix("line "))
    assert "TransducerOriginPixel" in new.decode().splitlines()[line - 1]


def test_pixel_sizes_that_fcal_itself_wrote_are_not_stale():
    size = np.linalg.norm(MATRIX[:3, :2], axis=0) * (1 + np.array([3.8e-4, -6.6e-4]))
    scaled = OTHER.replace("StylusTip", "TransducerOriginPixel").replace(
        '"Stylus" Matrix="1 0 0 0 0 1 ', f'"TransducerOrigin" Matrix="{size[0]} 0 0 0 0 {size[1]} '
    )
    assert patched_configuration(configuration(OLD, scaled), IMAGE, MATRIX)[1] == []


@pytest.mark.parametrize(
    ("sent", "inside", "message"),
    [
        ("ImageToProbe", [OLD], "sends ImageToProbe by itself, which overwrites this Image to"),
        (
            "ImageToTransducer",
            [OTHER.replace("StylusTip", "Transducer").replace('"Stylus"', '"Probe"')],
            "is a second path from Image, which PLUS refuses with every frame",
        ),
        ("ImageToTransducer", [OLD], ""),
        ("TransducerOriginPixelToTransducerOrigin", [OLD], ""),
        (
            "",
            [OTHER.replace("StylusTip", "Image").replace('"Stylus"', '"Reference"')],
            "line 7: Image to Reference is a second path from Image as soon as",
        ),
        (
            "",
            [OTHER.replace("StylusTip", "Image").replace('"Stylus"', '"UsProbe"')],
            "line 7: Image to UsProbe is a second path from Image as soon as the tracker sends "
            "Probe and UsProbe: take it out then",
        ),
    ],
)
def test_what_plus_hears_of_the_image_while_it_runs_is_told(sent, inside, message):
    old = configuration(*inside).replace(
        b"<Device Id='V'", f"<Device Id='V' ImageToTransducerTransformName='{sent}'".encode()
    )
    _, notes = patched_configuration(old, IMAGE, MATRIX)
    assert [message in note for note in notes] == ([True] if message else [])


@pytest.mark.parametrize(
    ("frames", "told"),
    [
        (
            IMAGE,
            [
                "line 7: ImageUS to ProbeUS is kept, and Image to Probe added beside it",
                "no tool is called Probe, there are 'ProbeUS', 'Reference'",
            ],
        ),
        (("Image", "ProbeUS"), ["line 7: ImageUS to ProbeUS is kept, and Image to ProbeUS added"]),
        (("ImageUS", "ProbeUS"), []),
    ],
)
def test_other_names_of_image_and_probe_are_told(frames, told):
    """PLUS would have gone on with the old transform, and no one would have noticed."""
    stated = OTHER.replace("StylusTip", "ImageUS").replace('"Stylus"', '"ProbeUS"')
    tools = [f"<DataSource Type='Tool' Id='{name}'/>" for name in ("probeUS", "Reference")]
    old = re.sub(
        rb"(<Device Id='V'[^/>]*)/>",
        rb"\1><DataSources>" + "".join(tools).encode() + b"</DataSources></Device>",
        configuration(stated),
    )
    assert b"probeUS" in old
    _, notes = patched_configuration(old, frames, MATRIX)
    assert len(notes) == len(told)
    assert all(note.startswith(start) for note, start in zip(notes, told, strict=True))


def test_paste_and_command():
    text = transform_element(IMAGE, MATRIX, error_mm=1.25, date=DATE)
    numbers = np.array(parse_xml(text.encode()).attributes["Matrix"].split(), float)
    np.testing.assert_array_equal(numbers.reshape(4, 4), MATRIX)
    command = parse_xml(update_transform_command(IMAGE, MATRIX, error_mm=0.5).encode())
    assert command.attributes["TransformName"] == "ImageToProbe"
    numbers = np.array(command.attributes["TransformValue"].split(), float)
    np.testing.assert_array_equal(numbers.reshape(4, 4), MATRIX)
    with pytest.raises(FormatError, match="cannot name a coordinate frame"):
        transform_element(('Image"><x/>', "Probe"), MATRIX)


# Real files.


@pytest.mark.parametrize(
    "name",
    [
        "PlusDeviceSet_IPEA_OptimizationMethod.xml",
        "PlusDeviceSet_fCal_Sim_SpatialCalibration_2.0.xml",
        "PlusDeviceSet_fCal_Sonix_NDIPolaris_LegoPhantom3_3Nwire.xml",
    ],
)
def test_real_configurations(real_data, name):
    path = real_data / "plus" / name
    old = path.read_bytes()
    first = next(parse_xml(old).all("CoordinateDefinitions/Transform")).attributes
    assert read_transform(path, first["From"], first["To"]).matrix.shape == (4, 4)
    new, _ = patched_configuration(old, IMAGE, MATRIX)
    found = found_element(parse_xml(new))
    assert old.startswith(new[: found.start].rstrip())
    for had in filter(is_between, transforms(old)):
        assert new[: had.start] == old[: had.start]
        assert new[found.end :] == old[had.end :]


DRESSES = {
    "crlf": lambda text: re.sub(rb"\r?\n", b"\r\n", text),
    "lf": lambda text: text.replace(b"\r\n", b"\n"),
    "bom": lambda text: b"\xef\xbb\xbf" + text,
    "tabs": lambda text: re.sub(rb"(?m)^ +", b"\t\t", text),
    "single quotes": lambda text: re.sub(rb'="([^"\'<>]*)"', rb"='\1'", text),
    "comments": lambda text: re.sub(
        rb"(<Transform )", b"<!-- <Transform From='Image' To='Probe'/> a > b -->\\1", text
    ),
    "one line": lambda text: re.sub(rb"\r?\n[ \t]*", b" ", text),
}
"""Other editors' hands; with the real files as they are, more than twenty configurations."""


@pytest.mark.parametrize("dress", DRESSES)
def test_real_configurations_in_another_dress(real_data, dress):
    """Of three real files no byte changes but those of the one element."""
    for path in sorted((real_data / "plus").glob("PlusDeviceSet_*.xml")):
        old = DRESSES[dress](path.read_bytes())
        new, _ = patched_configuration(old, IMAGE, MATRIX)
        found = found_element(parse_xml(new))
        matrix = np.array(found.attributes["Matrix"].split(), float).reshape(4, 4)
        np.testing.assert_allclose(matrix, MATRIX, rtol=1e-14)
        had = list(filter(is_between, transforms(old)))
        if had:
            assert new[: had[0].start] == old[: had[0].start]
            assert new[found.end :] == old[had[0].end :]
        else:
            assert old.startswith(new[: found.start].rstrip())
            assert old.endswith(new[found.end :].lstrip())


def test_fcal_result_reproduces_its_errors(real_data):
    """Each error of PLUS's report from wires, points and poses alone: fixes every convention."""
    result_path = real_data / "plus" / "IPEA_OptimizationMethod_Calibration.results.xml"
    known_path = real_data / "plus" / "PlusDeviceSet_IPEA_OptimizationMethod.xml"
    image_to_probe = read_transform(result_path).matrix
    phantom = read_transform(known_path, "Phantom", "Reference").matrix
    result, known = ElementTree.parse(result_path), ElementTree.parse(known_path)
    patterns = [
        {wire.get("Name"): [numbers(wire, f"EndPoint{end}") for end in ("Front", "Back")]
         for wire in pattern.iter("Wire")}
        for pattern in known.iterfind("PhantomDefinition/Geometry/Pattern")
    ]  # fmt: skip
    assert [len(pattern) for pattern in patterns] == [3, 3, 3]
    errors = []
    for frame in result.iterfind("ErrorReport/ValidationData/Frame"):
        tracked = {field.get("Name"): field for field in frame.iter("CustomFrameField")}
        seen = {point.get("WireName", point.get("ID")): numbers(point, "Position")[:2]
                for point in frame.iter("Point")}  # fmt: skip
        for error in frame.iterfind("ReprojectionError3DList/ReprojectionError3D"):
            stated = float(error.get("ErrorMm"))
            reference, probe = (
                numbers(tracked[f"{name}ToTrackerTransform"], "Value").reshape(4, 4)
                for name in ("Reference", "Probe")
            )
            pose = np.linalg.inv(reference) @ probe
            names = next(p for p in patterns if any(name in error.get("WireName") for name in p))
            wires = list(names.values())
            points = [next(v for k, v in seen.items() if k.endswith(name)) for name in names]
            in_phantom = middle_point(wires, points)
            there = np.linalg.inv(pose) @ phantom @ [*in_phantom, 1]
            here = image_to_probe @ [*points[1], 0, 1]
            found = np.linalg.norm(there - here)
            assert abs(found - stated) < 2e-3
            errors.append(found)
    assert len(errors) == 219
    kept = np.sort(errors)[: round(0.95 * len(errors))]
    statistics = result.find("ErrorReport/ReprojectionError3DStatistics")
    assert abs(kept.mean() - float(statistics.get("ValidationMeanMm"))) < 2e-4


def numbers(element, name):
    return np.array(element.get(name).split(), float)


def middle_point(wires, points):
    first, middle, third = wires
    alpha = np.linalg.norm(points[1] - points[0]) / np.linalg.norm(points[2] - points[0])
    crossing = [intersection(middle, first), intersection(middle, third)]
    return crossing[0] + alpha * (crossing[1] - crossing[0])


def intersection(line, other):
    a, b = line[1] - line[0], other[1] - other[0]
    solution = np.linalg.lstsq(np.stack([a, -b], axis=1), other[0] - line[0], rcond=None)[0]
    return line[0] + solution[0] * a


def test_command_line_leaves_a_refused_configuration(tmp_path, capsys):
    (tmp_path / "c.xml").write_bytes(configuration(OLD, OLD))
    np.save(tmp_path / "m.npy", np.diag([0.1, 0.2, 0.15, 1]))
    assert main(["export", str(tmp_path / "m.npy"), "--plus-config", str(tmp_path / "c.xml")]) == 2
    assert "2 transforms between" in capsys.readouterr().err
    assert (tmp_path / "c.xml").read_bytes() == configuration(OLD, OLD)
    # Nobody is told to remove a configuration that cannot be read.
    (tmp_path / "c.xml").write_bytes(configuration(OLD).decode().encode("utf-16"))
    assert main(["export", str(tmp_path / "m.npy"), "--plus-config", str(tmp_path / "c.xml")]) == 2
    assert "c.xml: is UTF-16 or UTF-32; save it as UTF-8" in capsys.readouterr().err
