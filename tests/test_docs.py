"""The documentation: its pages run, and what it says is there, spelt, and in a table."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
TOOLS = ROOT / "docs" / "tools"


@pytest.fixture(scope="module", autouse=True)
def _tools():
    """The documentation's own scripts, as ``docs/build.py`` finds them."""
    sys.path.insert(0, str(TOOLS))
    yield
    sys.path.remove(str(TOOLS))


QUICK = (
    "README.md",
    "docs/start.md",
    "docs/how-to/latency.md",
    "docs/reference/formats.md",
    "docs/understand/certificate.md",
    "docs/understand/frames.md",
    "docs/understand/prior.md",
)
"""Pages that compile little or nothing; ``python docs/build.py --execute`` runs all of them."""


@pytest.mark.parametrize("page", QUICK)
def test_the_blocks_of_a_page_run(page, tmp_path):
    import pages

    done = pages.run_page(ROOT / page, tmp_path)
    text = (ROOT / page).read_text(encoding="utf-8")
    assert text.count("figures/") == len(done.figures)
    for _, printed in done.printed:
        assert printed.strip()
    assert pages.differences(ROOT / page, done) == []


def test_an_output_that_a_page_shows_wrongly_is_found(tmp_path):
    import pages

    page = ROOT / "docs" / "no-such-page.md"
    (block,) = pages.blocks("<!-- output -->\n```text\n12 images, 0.25 mm\n1.234567e-3\n```\n")
    for printed, wrong in (
        ("12 images, 0.26 mm 1.234567e-3", None),
        ("12 images,\n0.25 mm 1.234568e-03", None),
        ("12 images, 0.28 mm 1.234567e-3", "shows '0.25', and prints '0.28'"),
        ("12 frames, 0.25 mm 1.234567e-3", "shows 'images,', and prints 'frames,'"),
        ("12 images, 0.25 mm", "shows '1.234567e-3', and prints ''"),
    ):
        found = pages.differences(page, pages.Run(printed=[(block, printed)]))
        assert found == ([] if wrong is None else [f"docs/no-such-page.md:3: {wrong}"])
    (block,) = pages.blocks("<!-- output: times -->\n```text\nin 17.3 s\n```\n")
    assert pages.differences(page, pages.Run(printed=[(block, "in 18.6 s")])) == []


def test_a_block_that_fails_is_told_with_its_line(tmp_path):
    import pages

    page = ROOT / "docs" / "no-such-page.md"
    blocks = pages.blocks("text\n\n```python\nx = 1\nraise ValueError('no')\n```\n")
    assert [block.line for block in blocks] == [4]
    with pytest.raises(pages.PageError, match=r"no-such-page\.md:4: ValueError: no"):
        pages._run_python(blocks[0], {}, f"{pages.name_of(page)}:{blocks[0].line}")
    (block,) = pages.blocks("```sh\njaxcal calibrate nothing.h5\n```\n")
    with pytest.raises(pages.PageError, match=r"exit 2: jaxcal: error: nothing\.h5"):
        pages._run_commands(block, "page:1")


def test_every_number_of_readme_and_results_is_in_a_table():
    import measured

    assert measured.problems() == []


def test_a_number_that_no_table_has_is_found(tmp_path, monkeypatch):
    import measured

    for name in measured.pages():
        copy = tmp_path / name
        copy.parent.mkdir(parents=True, exist_ok=True)
        copy.write_text((ROOT / name).read_text(encoding="utf-8"), encoding="utf-8")
    speed = tmp_path / measured.SPEED
    text = speed.read_text(encoding="utf-8")
    found = re.search(r"[\d,]+ trials a second", text)
    assert found
    right = found[0]
    speed.write_text(text.replace(right, f"9{right}") + "\nAnd 17 times as well.\n")
    monkeypatch.setattr(measured, "ROOT", tmp_path)
    wrong, unknown = measured.problems()
    assert "the tables say" in wrong
    assert right in wrong
    assert "17 comes from no table" in unknown
    measured.write()
    assert f" {right}" in speed.read_text(encoding="utf-8")


def test_links_words_names_and_examples():
    import checks

    assert checks.dead_links() == []
    assert checks.misspelt() == []
    assert checks.missing_names() == []
    assert checks.missing_examples() == []
    assert checks.missing_fields() == []
    assert checks.too_long() == []


def test_a_dead_link_a_wrong_word_and_a_silent_docstring_are_found(tmp_path, monkeypatch):
    import checks
    import pages

    page = tmp_path / "page.md"
    page.write_text("# A headin\n\n[one](gone.md) [two](#nowhere) [three](#a-headin)\n")
    monkeypatch.setattr(checks, "pages", lambda: [page])
    monkeypatch.setattr(pages, "ROOT", tmp_path)
    assert checks.dead_links() == [
        "page.md: dead link: gone.md",
        "page.md: no such heading: #nowhere",
    ]
    assert any("headin" in problem for problem in checks.misspelt())

    def silent(weight):
        """Do something."""

    assert checks._lacking(silent) == ["weight"]


def test_the_command_lines_page_is_what_help_says():
    import command_line

    assert command_line.PAGE.read_text(encoding="utf-8") == command_line.text()


def test_the_drawings_are_what_their_script_draws(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "docs" / "drawings"))
    import draw

    monkeypatch.setattr(draw, "HERE", tmp_path)
    draw.main()
    for drawing in sorted(tmp_path.glob("*.svg")):
        assert (ROOT / "docs" / "drawings" / drawing.name).read_text() == drawing.read_text()
    assert len(list(tmp_path.glob("*.svg"))) == 6
