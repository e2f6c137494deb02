"""What must hold of the documentation, each as a list of what does not hold."""

from __future__ import annotations

import ast
import importlib
import inspect
import re
from pathlib import Path
from types import ModuleType

import measured
from pages import DOCS, ROOT, blocks, name_of, pages

FORGE = "https://github.com/jaxcal/jaxcal/blob/main/"
_LINK = re.compile(r"\[[^\]]*\](?:\((?P<inline>[^)\s]+)\)|\[(?P<label>\w+)\])")
_LABEL = re.compile(r"^\[(\w+)\]: (\S+)$", re.MULTILINE)

MODULES = ("jaxcal", "jaxcal.design", "jaxcal.study", "jaxcal.backend")

ALSO_LINKED = ("CHANGELOG.md", "experiments/README.md", "tests/golden/README.md")
"""Files that are no pages, whose links are looked at as well."""

WORDS = Path(__file__).parent / "words.txt"


def all_problems() -> list[str]:
    """What is wrong, one line each."""
    return [
        *dead_links(),
        *misspelt(),
        *missing_names(),
        *missing_examples(),
        *missing_fields(),
        *measured.problems(),
        *too_long(),
    ]


def _without_code(text: str) -> str:
    """A page with its code blanked, so that places stay."""

    def blank(match: re.Match[str]) -> str:
        return re.sub(r"[^\n]", " ", match[0])

    text = re.sub(r"^```.*?^```$", blank, text, flags=re.MULTILINE | re.DOTALL)
    return re.sub(r"`[^`\n]*`", blank, text)


def _links(page: Path) -> list[str]:
    text = _without_code(page.read_text(encoding="utf-8"))
    labels = dict(_LABEL.findall(text))
    found = [m["inline"] or labels.get(m["label"], "") for m in _LINK.finditer(text)]
    return [link for link in found if link]


def _anchors(page: Path) -> set[str]:
    """Names of a page's headings, as Markdown's tools make them."""
    text = re.sub(
        r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL
    )
    names = set()
    for heading in re.findall(r"^#+ (.*)$", text, re.MULTILINE):
        plain = re.sub(r"[^\w\s-]", "", heading.lower()).strip()
        names.add(re.sub(r"[\s]+", "-", plain))
    return names


def dead_links() -> list[str]:
    """Links to files or headings that are not there, in the documentation and the repository."""
    found = []
    for page in [*pages(), *(ROOT / name for name in ALSO_LINKED)]:
        for link in _links(page):
            place, _, anchor = link.partition("#")
            if place.startswith(FORGE):
                target = ROOT / place.removeprefix(FORGE)
            elif re.match(r"https?://|mailto:", place):
                continue
            else:
                target = page if not place else (page.parent / place).resolve()
            if not target.exists():
                found.append(f"{name_of(page)}: dead link: {link}")
            elif anchor and target.suffix == ".md" and anchor not in _anchors(target):
                found.append(f"{name_of(page)}: no such heading: {link}")
    return found


def external_links() -> list[str]:
    """Links to other sites, which nothing here fetches."""
    every = {link for page in pages() for link in _links(page) if link.startswith("http")}
    return sorted(link for link in every if not link.startswith(FORGE))


def words_of(text: str) -> set[str]:
    """Words of a page's prose, in lower case."""
    text = _without_code(text)
    text = re.sub(r"<!--.*?-->", " ", text, flags=re.DOTALL)
    text = re.sub(r"\]\([^)]*\)|^\[\w+\]: \S+$|https?://\S+|^::: .*$", " ", text, flags=re.M)
    text = re.sub(r"(\$\$?)[^$]+\1", " ", text)
    return {word.lower() for word in re.findall(r"[^\W\d_]+(?:'[^\W\d_]+)?", text)}


def known_words() -> set[str]:
    """The committed list of words: one a line, read and found right by a person."""
    return set(WORDS.read_text(encoding="utf-8").split())


def misspelt() -> list[str]:
    """Words that are not on the list: misspelt, or to be added to it."""
    known, found = known_words(), []
    for page in pages():
        unknown = words_of(page.read_text(encoding="utf-8")) - known
        if unknown:
            found.append(
                f"{name_of(page)}: not in docs/tools/words.txt: {', '.join(sorted(unknown))}"
            )
    return found


def public_names(module: ModuleType) -> list[str]:
    """What docs/reference/python.md calls public."""
    names = getattr(module, "__all__", None) or dir(module)
    return [name for name in names if not name.startswith("_")]


def _where(module: str, name: str) -> str:
    """``module.name`` of the definition behind a public name."""
    value = getattr(importlib.import_module(module), name)
    if inspect.isclass(value) or inspect.isfunction(inspect.unwrap(value)):
        return f"{value.__module__}.{value.__qualname__}"
    return name


def _references() -> dict[str, str]:
    """What the reference pages show: dotted name -> page."""
    found = {}
    for page in sorted((DOCS / "reference").glob("*.md")):
        for name in re.findall(r"^::: (\S+)$", page.read_text(encoding="utf-8"), re.MULTILINE):
            found[name] = name_of(page)
    return found


def missing_names() -> list[str]:
    """Public names that are on no reference page, or whose docstring does not say enough."""
    shown, found = _references(), []
    for module in MODULES:
        for name in public_names(importlib.import_module(module)):
            home = _where(module, name)
            if home not in shown and not any(key.endswith(f".{name}") for key in shown):
                found.append(f"docs/reference: {module}.{name} is on no page")
                continue
            value = getattr(importlib.import_module(module), name)
            lacking = _lacking(value)
            if lacking:
                found.append(f"{home}: its docstring says nothing of {', '.join(lacking)}")
    return found


def _lacking(value: object) -> list[str]:
    """What the docstring of a public thing leaves out."""
    text = inspect.getdoc(value) or ""
    if inspect.isclass(value):
        if issubclass(value, Exception):
            return [] if text else ["itself"]
        own = getattr(value, "__annotations__", {})
        fields = [
            name for name in own if not name.startswith("_") and "ClassVar" not in str(own[name])
        ]
        return [name for name in fields if not re.search(rf"\b{name}\b", text)]
    function = inspect.unwrap(value) if callable(value) else None
    if not inspect.isfunction(function):
        return []
    taken = [name for name in inspect.signature(function).parameters if name not in ("self", "cls")]
    return [name for name in taken if not re.search(rf"\b{name}\b", text)]


def _called() -> set[str]:
    """Names that a block which is run calls or reads as an attribute."""
    names: set[str] = set()
    for page in pages():
        for block in blocks(page.read_text(encoding="utf-8")):
            if block.language == "python" and block.mark in (None, "setup"):
                for node in ast.walk(ast.parse(block.code)):
                    if isinstance(node, ast.Attribute):
                        names.add(node.attr)
                    elif isinstance(node, ast.Name):
                        names.add(node.id)
    return names


def missing_examples() -> list[str]:
    """Public functions that no block uses which is run."""
    called, found = _called(), []
    for module in MODULES:
        there = importlib.import_module(module)
        for name in public_names(there):
            function = (
                inspect.unwrap(getattr(there, name)) if callable(getattr(there, name)) else None
            )
            if inspect.isfunction(function) and name not in called:
                found.append(f"docs: no block that is run uses {module}.{name}")
    return found


def missing_fields() -> list[str]:
    """Fields of the JSON that its page does not explain."""
    text = (DOCS / "reference" / "json.md").read_text(encoding="utf-8")
    fields: list[str] = []
    for name in ("report/record.py", "report/certified.py", "cli/calibrate.py"):
        tree = ast.parse((ROOT / "jaxcal" / name).read_text(encoding="utf-8"))
        for node in ast.walk(tree):
            functions = ("calibration_record", "certificate_record", "_resampled")
            if isinstance(node, ast.FunctionDef) and node.name in functions:
                fields += _keys(node)
    assert "image_plane_to_probe" in fields, "the record is made elsewhere now"
    return [
        f"docs/reference/json.md: {field} is not explained"
        for field in sorted(set(fields))
        if f"`{field}`" not in text
    ]


def _keys(function: ast.FunctionDef) -> list[str]:
    """Names that a function puts into its record: of displays, and by assignment."""
    found: list[ast.expr | None] = []
    for node in ast.walk(function):
        if isinstance(node, ast.Dict):
            found += node.keys
        elif isinstance(node, ast.Subscript) and isinstance(node.ctx, ast.Store):
            found.append(node.slice)
    return [
        key.value for key in found if isinstance(key, ast.Constant) and isinstance(key.value, str)
    ]


def too_long() -> list[str]:
    """The README is a door."""
    words = len((ROOT / "README.md").read_text(encoding="utf-8").split())
    return [f"README.md: {words} words, more than 700"] if words > 700 else []
