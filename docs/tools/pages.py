"""The pages of the documentation, and the running of what stands on them.

Every fenced block in the language ``python`` or ``sh`` is run, page by page, in a folder of its own
that is empty at first. A page's Python blocks share their names. A comment before a block says
otherwise:

- ``<!-- not run: REASON -->``: the block needs what a build does not have (a robot, a network).
- ``<!-- file: NAME -->``: the block, of whatever language, is written to this file.
- ``<!-- setup: NAME -->``: the script of this name in ``docs/data`` is run first; it makes files
  that a reader has.
- ``<!-- output -->``: the block is what the block before it printed; a build rewrites it.
- ``<!-- output: REASON -->``: likewise, but its numbers are not compared (times, for example).

A file ``NAME.svg`` or ``NAME.png`` that a page's code saves, and that the page shows from
``figures/``, becomes that figure. Commands of ``sh`` blocks run in this process, so that one
compilation serves all pages.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import runpy
import shlex
import shutil
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import zip_longest
from pathlib import Path

DOCS = Path(__file__).resolve().parents[1]
ROOT = DOCS.parent
FIGURES = DOCS / "figures"
DATA = DOCS / "data"

LANGUAGES = ("python", "sh")
_FENCE = re.compile(
    r"(?:^<!-- (?P<mark>not run|file|setup|output)(?:: (?P<what>[^\n]*?))? -->\n+)?"
    r"^```(?P<language>[\w-]*)\n(?P<code>.*?)^```$",
    re.MULTILINE | re.DOTALL,
)


class PageError(Exception):
    """A block of a page did not run; the message says which and why."""


@dataclass(frozen=True)
class Block:
    """A fenced block of a page.

    Attributes:
        language: of the fence; empty for none.
        code: without the fence.
        mark: ``not run``, ``file``, ``setup``, ``output`` or None.
        what: what the mark says after its colon.
        line: where the code begins, counted from 1.
        span: of ``code`` in the page's text.
    """

    language: str
    code: str
    mark: str | None
    what: str | None
    line: int
    span: tuple[int, int]


@dataclass
class Run:
    """What came of running a page.

    Attributes:
        names: of its Python blocks.
        printed: by blocks whose output the page shows, each with the block that shows it.
        figures: files that the page shows and its code has saved.
        seconds: wall time.
    """

    names: dict[str, object] = field(default_factory=dict)
    printed: list[tuple[Block, str]] = field(default_factory=list)
    figures: list[Path] = field(default_factory=list)
    seconds: float = 0.0


def pages() -> list[Path]:
    """README and every page of the site, in order of their paths."""
    own = (page for page in DOCS.rglob("*.md") if "upstream" not in page.parts)
    return [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(own)]


def name_of(page: Path) -> str:
    """The page's path in the repository, with slashes."""
    return page.relative_to(ROOT).as_posix()


def blocks(text: str) -> list[Block]:
    """All fenced blocks of a page."""
    found = []
    for match in _FENCE.finditer(text):
        line = text.count("\n", 0, match.start("code")) + 1
        found.append(
            Block(
                match["language"], match["code"], match["mark"], match["what"], line,
                match.span("code"),
            )
        )  # fmt: skip
    return found


def runs(text: str) -> bool:
    """Whether anything on this page is run."""
    return any(
        block.language in LANGUAGES and block.mark in (None, "setup") for block in blocks(text)
    )


def run_page(page: Path, folder: Path) -> Run:
    """Run a page in a folder.

    Args:
        page: the Markdown file.
        folder: where; it should be empty.

    Raises:
        PageError: a block failed.
    """
    text = page.read_text(encoding="utf-8")
    done = Run(names={"__name__": "__page__"})
    said, began = "", time.perf_counter()
    with _inside(folder):
        for block in blocks(text):
            where = f"{name_of(page)}:{block.line}"
            if block.mark == "setup":
                runpy.run_path(str(DATA / str(block.what)), run_name="__main__")
            if block.mark == "output":
                done.printed.append((block, said))
            elif block.mark == "file":
                assert block.what is not None, where
                Path(block.what).write_text(block.code, encoding="utf-8")
            elif block.mark in (None, "setup") and block.language == "python":
                said = _run_python(block, done.names, where)
            elif block.mark in (None, "setup") and block.language == "sh":
                said = _run_commands(block, where)
    for shown in re.findall(r"\]\((?:\.\./)*(?:docs/)?figures/([\w-]+\.(?:svg|png))", text):
        if (folder / shown).is_file():
            done.figures.append(folder / shown)
    done.seconds = time.perf_counter() - began
    return done


_NUMBER = re.compile(r"[-+]?\d[\d,]*(?:\.\d+)?(?:e[-+]?\d+)?")


def differences(page: Path, done: Run) -> list[str]:
    """Where a page shows another output than its blocks printed, one line each.

    Words must be the same; line breaks do not count. Numbers may differ by rounding: by one and a
    half units of their last digit, or by a millionth.
    """
    found = []
    for block, printed in done.printed:
        for shown, said in zip_longest(block.code.split(), printed.split(), fillvalue=""):
            same = _NUMBER.sub("0", shown) == _NUMBER.sub("0", said)
            if same and block.what is None:
                pairs = zip(_NUMBER.findall(shown), _NUMBER.findall(said), strict=True)
                same = all(_is_rounded(*pair) for pair in pairs)
            if not same:
                found.append(f"{name_of(page)}:{block.line}: shows {shown!r}, and prints {said!r}")
                break
    return found


def _is_rounded(shown: str, said: str) -> bool:
    """Whether two numbers agree but for rounding."""
    first, second = (float(number.replace(",", "")) for number in (shown, said))
    digits, _, exponent = shown.partition("e")
    unit = 10.0 ** (int(exponent or 0) - len(digits.partition(".")[2]))
    return abs(first - second) <= max(1.5 * unit, 1e-6 * abs(first))


def rewrite(page: Path, done: Run) -> None:
    """Put what a run printed and drew into the page and beside it."""
    text = page.read_text(encoding="utf-8")
    for block, printed in reversed(done.printed):
        start, end = block.span
        lines = [line.rstrip() for line in printed.splitlines()]
        text = text[:start] + "\n".join(lines).rstrip() + "\n" + text[end:]
    page.write_text(text, encoding="utf-8")
    FIGURES.mkdir(exist_ok=True)
    for figure in done.figures:
        shutil.copyfile(figure, FIGURES / figure.name)


@contextlib.contextmanager
def _inside(folder: Path) -> Iterator[None]:
    import jax

    before, columns = Path.cwd(), os.environ.get("COLUMNS")
    bits = jax.config.jax_enable_x64
    # A page may change what a reader's process may change; the next page begins as that one did.
    jax.config.update("jax_enable_x64", False)
    os.chdir(folder)
    os.environ["COLUMNS"] = "100"
    # As for a reader's script, which imports modules beside it.
    sys.path.insert(0, str(folder))
    for data in sorted(DATA.glob("*.txt")) + sorted(DATA.glob("*.csv")):
        shutil.copyfile(data, folder / data.name)
    try:
        yield
    finally:
        sys.path.remove(str(folder))
        jax.config.update("jax_enable_x64", bits)
        os.chdir(before)
        if columns is None:
            del os.environ["COLUMNS"]
        else:
            os.environ["COLUMNS"] = columns


def _run_python(block: Block, names: dict[str, object], where: str) -> str:
    printed = io.StringIO()
    code = "\n" * (block.line - 1) + block.code
    try:
        with contextlib.redirect_stdout(printed), warnings.catch_warnings():
            warnings.simplefilter("error")
            exec(compile(code, where, "exec"), names)
    except Exception as error:
        raise PageError(f"{where}: {type(error).__name__}: {error}") from error
    finally:
        if "matplotlib.pyplot" in sys.modules:
            sys.modules["matplotlib.pyplot"].close("all")
    return printed.getvalue()


def _run_commands(block: Block, where: str) -> str:
    from hw.cli.main import main as bench
    from jaxcal.cli.main import main as engine

    printed = io.StringIO()
    for line in block.code.replace("\\\n", " ").splitlines():
        program, *arguments = shlex.split(line, comments=True) or [""]
        if not program:
            continue
        into = None
        if ">" in arguments:
            into = arguments[arguments.index(">") + 1]
            arguments = arguments[: arguments.index(">")]
        main = {"jaxcal": engine, "jaxcal-hw": bench}.get(program)
        if main is None:
            raise PageError(f"{where}: {program!r} is no command of ours: say why it is not run")
        out, trouble = io.StringIO(), io.StringIO()
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(trouble):
            status = main(arguments)
        if status:
            raise PageError(f"{where}: {line}: exit {int(status)}: {trouble.getvalue()}")
        if into is None:
            printed.write(out.getvalue())
        else:
            Path(into).write_text(out.getvalue(), encoding="utf-8")
    return printed.getvalue()


def run_all(chosen: list[Path], write: bool) -> Iterator[tuple[Path, Run | PageError]]:
    """Run pages one after the other, each in a folder of its own.

    Args:
        chosen: the pages; those on which nothing is run are passed over.
        write: whether to put outputs and figures into the pages; else outputs are compared.

    Yields:
        A page, and what came of it or why it failed.
    """
    for page in chosen:
        if not runs(page.read_text(encoding="utf-8")):
            continue
        with tempfile.TemporaryDirectory(prefix="jaxcal-docs-") as folder:
            try:
                done = run_page(page, Path(folder))
            except PageError as error:
                yield page, error
                continue
            if write:
                rewrite(page, done)
            elif stale := differences(page, done):
                yield page, PageError("\n".join(stale))
                continue
        yield page, done
