"""Files that lie, from the command line: one clear line, bounded memory, and nothing written."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest
from conftest import png

from jaxcal.io.sequence_files import write_sequence

PAIR = ("Probe", "Tracker")
LARGEST_GROWTH = 200e6
"""Bytes: of what is asked for here the least is a gigabyte."""

RUN = """
import contextlib, io, json, resource, sys
from jaxcal.cli.main import main
import numpy, h5py, PIL.Image, jaxcal.data.segmentation.image, jaxcal.io.importing.files
def rss():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
for arguments in json.loads(sys.argv[1]):
    before, error = rss(), io.StringIO()
    with contextlib.redirect_stderr(error), contextlib.redirect_stdout(io.StringIO()):
        code = main(arguments)
    print(json.dumps([int(code), error.getvalue(), rss() - before]))
"""


def sequence(path: Path, change, **options) -> None:
    """Five frames of tracking, and pixels where asked for; then a change of its bytes."""
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, :3, 3] = np.arange(15).reshape(5, 3)
    write_sequence(path, {PAIR: poses}, 10 + np.arange(5) / 10, **options)
    content = path.read_bytes()
    changed = change(content)
    assert changed != content
    path.write_bytes(changed)


def swap(old: bytes, new: bytes):
    return lambda content: re.sub(old, new, content, count=1)


IMAGES = {"images": [np.full((40, 50), k, np.uint8) for k in range(5)]}
FIRST = rb"(Seq_Frame0001_ProbeToTrackerTransform ?:?= ?)"
REFLECTED = b"-1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"


def bomb(content: bytes) -> bytes:
    """Pixels that inflate to a gigabyte: a megabyte compressed once, a thousand times."""
    packer = zlib.compressobj(1, wbits=-15)
    block = packer.compress(bytes(1 << 20)) + packer.flush(zlib.Z_FULL_FLUSH)
    checksum = (1000 << 20) % 65521 << 16 | 1
    packed = b"\x78\x01" + 1000 * block + packer.flush() + checksum.to_bytes(4, "big")
    head = content[: content.index(b"LOCAL\n") + 6]
    head = re.sub(rb"CompressedDataSize = \d+", b"CompressedDataSize = %d" % len(packed), head)
    return re.sub(rb"DimSize = \d+ \d+ 5", b"DimSize = 8000 8000 5", head) + packed


def entities() -> str:
    """A thousand million laughs."""
    laughs = "".join(f'<!ENTITY l{k} "{f"&l{k - 1};" * 10}">' for k in range(1, 10))
    return f'<!DOCTYPE z [<!ENTITY l0 "ha">{laughs}]><PlusConfiguration>&l9;</PlusConfiguration>'


TABLE = ["x [mm]", "y [mm]", "z [mm]", "qx", "qy", "qz", "qw", "u", "v"]


def table(path: Path, names=TABLE, times=None) -> None:
    rows = np.column_stack([np.arange(15).reshape(5, 3), np.tile([0, 0, 0, 1], (5, 1)),
                            np.arange(10).reshape(5, 2)])  # fmt: skip
    lines = [",".join(map(str, row)) for row in rows.tolist()]
    if times is not None:
        names = ["time", *names]
        lines = [f"{t},{line}" for t, line in zip(times, lines, strict=True)]
    path.write_text("\n".join([",".join(names), *lines]))


@pytest.fixture(scope="module")
def told(tmp_path_factory):
    """What became of each command, all in one process that has imported what it needs."""
    folder = tmp_path_factory.mktemp("hostile")
    (folder / "secret").write_text("root:x:0:0\n")
    (folder / "in").mkdir()
    made: dict[str, tuple[list[str], str]] = {}

    def add(name: str, message: str, *arguments: str) -> None:
        made[name] = (list(arguments), message)

    def hostile(name: str, message: str, change, file="s.igs.mha", **options) -> None:
        path = folder / "in" / f"{name}.{file.partition('.')[2]}"
        sequence(path, change, **options)
        add(name, message, "import", str(path), str(folder / f"{name}.h5"))

    raw = {**IMAGES, "compressed": False}
    hostile("passwd", "only LOCAL", swap(b"LOCAL", b"/etc/passwd"), **IMAGES)
    hostile("parent", "only LOCAL", swap(b"LOCAL", b"../secret"), **IMAGES)
    hostile(
        "nrrd-parent", "data file", swap(b"\n\n", b"\ndata file: ../secret\n\n"), "s.nrrd", **IMAGES
    )
    hostile(
        "ten-gigabytes", "claims", swap(rb"DimSize = 50 40 5", b"DimSize = 4000 4000 800"), **raw
    )
    hostile(
        "frames", "2147483648", swap(rb"DimSize = 50 40 5", b"DimSize = 50 40 2147483648"), **raw
    )
    hostile("zlib", "px are too large", bomb, **IMAGES)
    hostile("fifteen", "16 numbers, not 15", swap(FIRST + rb"\S+ ", rb"\1"), **IMAGES)
    hostile("nan", "holds NaN", swap(FIRST + rb"\S+ ", rb"\1nan "), **IMAGES)
    hostile("reflected", "reflection", swap(FIRST + rb"[^\n]*", rb"\g<1>" + REFLECTED), **IMAGES)
    for name in ("duplicate", "unordered"):
        path = folder / "in" / f"{name}.mha"
        stamp = b"10.2" if name == "duplicate" else b"10.05"
        sequence(path, swap(rb"(Seq_Frame0003_Timestamp = )\S+", rb"\g<1>" + stamp))
        (folder / "in" / "p.csv").write_text("frame,u,v\n0,1,2\n1,3,4\n2,9,9\n3,5,6\n4,7,7\n")
        add(name, "is not later than the one before", "import", str(path),
            str(folder / "in" / "p.csv"), str(folder / f"{name}.h5"))  # fmt: skip
    table(folder / "in" / "mixed.csv", ["x [mm]", "y [m]", *TABLE[2:]])
    table(folder / "in" / "back.csv", times=[0, 1, 2, 2, 3])
    for name, message in (("mixed", "different units"), ("back", "is not later than the one")):
        add(name, message, "import", str(folder / "in" / f"{name}.csv"), str(folder / f"{name}.h5"))
    lost = b"Seq_Frame0000_A%dToBTransform = 0\nSeq_Frame0000_A%dToBTransformStatus = INVALID\n"
    poses = b"".join(lost % (k, k) for k in range(100))
    hostile("transforms", "more than 10 transforms in 100000 frames",
            swap(rb"DimSize = 1 1 5", b"DimSize = 0 0 100000\n" + poses))  # fmt: skip
    tools = ",".join(f"Port {k},State,Q0,Qx,Qy,Qz,Tx,Ty,Tz" for k in range(3000))
    (folder / "in" / "tools.csv").write_text(f"Tools,{tools}\n" + "3\n" * 100_000)
    add("tools", "more than 1000000 poses of 3000 tools", "import",
        str(folder / "in" / "tools.csv"), str(folder / "tools.h5"))  # fmt: skip
    wide = ",".join(f"c{k}" for k in range(100_000))
    (folder / "in" / "blank.csv").write_text(f"{wide}\n" + ",\n" * 2000 + "1\n")
    add("blank", "1 columns, the header has 100000", "import", str(folder / "in" / "blank.csv"),
        str(folder / "blank.h5"))  # fmt: skip
    (folder / "in" / "laughs.xml").write_text(entities())
    add("laughs", "document types", "export", str(folder / "in" / "laughs.xml"), "--slicer",
        str(folder / "laughs.tfm"))  # fmt: skip
    (folder / "in" / "png").mkdir()
    (folder / "in" / "png" / "a1.png").write_bytes(
        png(60_000, 60_000, zlib.compress(bytes(1 << 20)))
    )
    add("png", "claims", "import", str(folder / "in" / "png"), str(folder / "png.h5"), "--poses",
        str(folder / "in" / "back.csv"))  # fmt: skip
    (folder / "in" / "deep.json").write_text("[" * 10**6)
    add("deep", "JSON", "export", str(folder / "in" / "deep.json"), "--plus", str(folder / "d.xml"))
    before = sorted(path.name for path in folder.iterdir())
    commands = json.dumps([arguments for arguments, _ in made.values()])
    done = subprocess.run([sys.executable, "-P", "-c", RUN, commands], capture_output=True,
                          text=True, timeout=300, check=True)  # fmt: skip
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    assert sorted(path.name for path in folder.iterdir()) == before, "something was written"
    return {name: (*row, message) for (name, (_, message)), row in
            zip(made.items(), rows, strict=True)}  # fmt: skip


@pytest.mark.parametrize("name", [
    "passwd", "parent", "nrrd-parent", "ten-gigabytes", "frames", "zlib", "fifteen", "nan",
    "reflected", "duplicate", "unordered", "mixed", "back", "laughs", "png", "deep", "transforms",
    "tools", "blank",
])  # fmt: skip
def test_hostile(told, name):
    code, error, growth, message = told[name]
    assert code == 2
    assert error.count("\n") == 1
    assert re.search(message, error), error
    assert "internal error" not in error
    assert growth < LARGEST_GROWTH
