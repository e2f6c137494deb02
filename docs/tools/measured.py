"""Where each number of the README and of the results pages comes from, and some of other pages.

The claims stand in ``claims_*.py``. On the pages of :data:`claims.PAGES` no other number may stand
beside them but settings; on other pages the claims alone are compared.
``python docs/tools/measured.py`` lists what is not as the tables in ``experiments/results`` say;
``--write`` puts the tables' present values into the sentences (read them afterwards: what a number
means may have changed with it).
"""

from __future__ import annotations

import re
import sys

# These register their claims.
import claims_accuracy  # noqa: F401
import claims_bench  # noqa: F401
import claims_guides  # noqa: F401
import claims_paper  # noqa: F401
import claims_speed  # noqa: F401
import claims_trust  # noqa: F401
import claims_unmodelled  # noqa: F401
from claims import (
    ACCURACY,
    CLAIMS,
    EXPERIMENT,
    INDEX,
    PAGES,
    PAPER,
    PLANNED,
    README,
    ROOT,
    SPEED,
    VERDICT,
)

SETTINGS: dict[str, tuple[str, ...]] = {
    README: (
        "PLUS and 3D Slicer",
        "Boctor (2017)",
        "about 30 images with",
        "tilted by 20 to 30 degrees",
        "expect up to 0.5 mm, up to 1.5 mm of error in the image",
        "Python 3.11 to 3.14",
        "BSD 3-clause",
    ),
    INDEX: ("from 21 to 30 November 2026", "a machine with 16 cores", "some with only 8 images"),
    ACCURACY: (
        "+- is a 95 % interval",
        "| mean at size 1 mm | SD at size 1 mm |",
        "(offsets off centre, 8 images)",
        "with heavy tails from 50 images on",
        "significantly below and above 1:",
        "With offsets of 5 mm, 10 mm of noise and 30 % mixed outliers",
        "Outliers of 2 to 20 mm were not tried",
        "7 x 7 grid of offsets and noise, for five distributions of the offsets, with 50 images",
        "with 12, 20 and 200 images",
        "bound of 1 mm and our default stopping rule",
        "(0.125 to 4 times the true one)",
        "(1 to 256)",
        "7 x 6 cells for each of four symmetric distributions, 50 images",
        "12 and 50 images. How often 95 % intervals",
        "| method | 12 images | 50 images |",
        "How often the 95 % interval of TRE",
        "how often 95 % intervals hold with prior",
        "the TRE at 20 points of the image",
        "With 25 images, an SD of 0.5 mm and a mean of 8 mm",
        "10 % and 30 % of the images 20 to 100 mm off, three distributions, five cells of the grid "
        "with 50 images, and 12, 20 and 200 images",
        "if 30 % of the images slipped together",
        "54 hand-picked points",
        "exactly poses 336 to 479",
        "64 simulated benches of 60 images",
        "offsets to 1, 3 and 5 mm, channel noise 0.05 to 2 mm, 500 trials a cell",
        "2 % and 0.5 us off, 500 trials a cell",
        "10000 frames a cell",
        "clocks of 20 and 100 MHz",
        "from 0.5 mm of noise on",
        "off-centre by three SDs",
        "a mean in one recording of ten; with 8, 20 and 50 images",
        "where the alternation's bound of 1 mm is",
        "(12, 30 and 60 images, target all over the image or in its middle)",
        "likelihood can have two maxima there",
        "at 17 points instead of taking the maximum",
    ),
    VERDICT: (
        "exceeds the upper end of its 95 % interval",
        "1000 clean recordings each of 12, 30 and 60 images, and 200 each with one of twelve "
        "faults",
        "recordings with 12 / 30 / 60 images",
        "with 12 images many faults",
        "distances with an SD of 0.5 mm",
        "500 clean recordings each, and 100 with each fault",
        "250 clean recordings for each of three distributions",
        "| named in clean recordings | 30 images | 54 | 200 |",
        "a range 5 SDs too long",
        "at about 40 mm/s, 30 poses a second; 300 recordings without a lag and 60 with each lag, "
        "of 20 images, one a second, of 40, one every 0.9 s, and of 100, one every 0.2 s",
        "(200 ms, of the 100 images)",
        "400 recordings a condition",
        "how often its 95 % intervals contain the truth",
        "for 100 of the recordings",
        "| the same 100 |",
        "With a correlation of 0.6 the intervals",
        "share (%) of 100 smooth sweeps of each kind in which the truth is outside the 99 % "
        "interval of at least one of X's six parameters (right intervals: in up to 6 %)",
        "| truth outside such an interval, and | 12 images | 20 | 30 | 100 in five seconds |",
        "200 recordings each of 12, 30 and 60 images, with uniform offsets up to 1 mm or normal "
        "or heavy-tailed ones with an SD of 1 mm, calibrated with `--prior bounded` and a bound of "
        "0.25 to 4 mm",
    ),
    PLANNED: (
        "2000 trials a cell (re-planned: 192), offsets of SD 1 mm, 0.5 mm of noise",
        "assumed 3 times too large",
        "planning anew after 8 and more images",
        "as good as 60 of the Sobol plan",
        "60 planned poses determine it",
        "400 recordings each of 12, 30 and 60 images, and ranges that are too long by 1 mm at 20 "
        "mm to the side",
        "exceeds the upper end of its 95 % interval",
        "27 of its 54 images, chosen by the criterion, predict the other 27",
    ),
    PAPER: (
        "Journal of Medical Imaging 4(3), 2017",
        "448 trials a cell",
        "the paper's mean +- 1 SD",
        "| Table 1 | Table 2 | Table 3 |",
        "At noises of 4 mm and more",
        "dips at 0.5 to 1 mm",
        "30 rounds of warm-up",
        "200 problems, one start",
        "from 1e-4 to 1e-10, a joint step multiplies it by 1e-4",
        "turned by up to 2 degrees",
    ),
    EXPERIMENT: (
        "Sections 3.2, 3.3, 4.2 and 4.3 of the paper",
        "128 times where the paper had one",
        "with 95 % intervals",
        "Table 4",
        "*Best of 3*",
        "boxes (95 % of the experiments)",
        "experiment 2",
        "experiment 4",
        "experiment 3 (element 2.08 mm, beam 0.8 mm, 60 images, cone 30 degrees, repeatability "
        "0.1 mm, SD of the sound speed 5 m/s, pose error 0.55 mm)",
        "not with 120 images",
        "*95 % quantile* is one bound for all images, which 95 % of the true distances",
        "(section 4.3, future work)",
        "without errors (mm), 60 images",
    ),
    SPEED: (
        "AVX-512",
        "Zen 4",
        "to segment a trial of 50 x 128",
        "with 50 images",
        "start 20 degrees and 20 mm off",
        "a tolerance of 1e-9, scipy at 1e-8 (its default) and optimistix at 1e-3",
        "on an NVIDIA H100",
    ),
}
"""Numbers that are no results: what an experiment was set to, dates, names."""

_NUMBER = re.compile(r"\d[\d.,]*")


def plain(text: str) -> str:
    """A page without code, addresses and headings, which hold no results; places stay.

    Tables that a script writes from its results are left out as well: tests compare them.
    """

    def blank(match: re.Match[str]) -> str:
        return re.sub(r"[^\n]", " ", match[0])

    for pattern in (
        r"^```.*?^```$", r"`[^`\n]*`", r"\]\([^)]*\)", r"^\[\w+\]: .*$", r"\]\[\w+\]", r"^#.*$",
        r"<!-- table: .*?<!-- end -->", r"<!--.*?-->",
    ):  # fmt: skip
        flags = re.MULTILINE | re.DOTALL if "```" in pattern or "<!--" in pattern else re.MULTILINE
        text = re.sub(pattern, blank, text, flags=flags)
    return text


def pages() -> tuple[str, ...]:
    """Every page with a claim."""
    return tuple(dict.fromkeys((*PAGES, *(piece.page for piece in CLAIMS))))


def problems() -> list[str]:
    """What is not as the tables say, one line each."""
    found = []
    for page in pages():
        text = (ROOT / page).read_text(encoding="utf-8")
        known = [False] * len(text)
        for piece in (c for c in CLAIMS if c.page == page):
            matches = list(piece.pattern().finditer(text))
            wanted = piece.text()
            if not matches:
                found.append(f"{page}: nowhere: {wanted}")
            for match in matches:
                if re.sub(r"\s+", " ", match[0]) != re.sub(r"\s+", " ", wanted):
                    found.append(f"{page}: the tables say: {wanted}")
                known[match.start() : match.end()] = [True] * (match.end() - match.start())
        for words in SETTINGS.get(page, ()):
            pattern = r"\s+".join(re.escape(word) for word in words.split())
            matches = list(re.finditer(pattern, text))
            if not matches:
                found.append(f"{page}: nowhere: {words}")
            for match in matches:
                known[match.start() : match.end()] = [True] * (match.end() - match.start())
        for match in _NUMBER.finditer(plain(text)) if page in PAGES else ():
            if not known[match.start()]:
                line = text.count("\n", 0, match.start()) + 1
                around = " ".join(text[max(match.start() - 30, 0) : match.end() + 20].split())
                found.append(f"{page}:{line}: {match[0]} comes from no table: ... {around} ...")
    return found


def write() -> None:
    """Put the tables' present values into the pages; sentences that are right keep their lines."""
    for piece in CLAIMS:
        path, wanted = ROOT / piece.page, piece.text()

        def renewed(match: re.Match[str], wanted: str = wanted) -> str:
            return match[0] if match[0].split() == wanted.split() else wanted

        text = path.read_text(encoding="utf-8")
        path.write_text(piece.pattern().sub(renewed, text), encoding="utf-8")


def main() -> int:
    """Run the command line; returns the exit status."""
    if sys.argv[1:] == ["--write"]:
        write()
    found = problems()
    print("\n".join(found))
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
