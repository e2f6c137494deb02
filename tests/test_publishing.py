"""What is published agrees with itself: versions, links, names."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import jaxcal

ROOT = Path(__file__).parents[1]
SETTINGS = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
PROJECT = SETTINGS["project"]


def test_one_version():
    assert PROJECT["version"] == jaxcal.__version__
    citation = (ROOT / "CITATION.cff").read_text("utf-8")
    assert f"\nversion: {jaxcal.__version__}\n" in citation


def test_links_of_the_readme_work_outside_the_repository():
    shown = (ROOT / "README.md").read_text("utf-8")
    hook = SETTINGS["tool"]["hatch"]["metadata"]["hooks"]["fancy-pypi-readme"]
    for each in hook["substitutions"]:
        shown = re.sub(each["pattern"], each["replacement"], shown)
    targets = re.findall(r"\]\(([^)]+)\)", shown)
    assert targets
    home = PROJECT["urls"]["Homepage"] + "/blob/main/"
    for target in targets:
        assert target.startswith(("https://", "#")), target
        if target.startswith(home):
            assert (ROOT / target.removeprefix(home)).exists(), target
