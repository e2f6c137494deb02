"""Modules import one way: no circles, and none imports a folder of its package above its own.

The sources are read, not imported. Imports within functions may close a circle or point upwards
only where they are listed here.
"""

from __future__ import annotations

import ast
import re
from collections import defaultdict
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

HOME = Path(__file__).parents[1]

LAYERS = {
    "jaxcal": (
        "runtime",
        "data",
        "io",
        "model",
        "solvers",
        "result",
        "diagnostics",
        "calibration",
        "study",
        "design",
        "report",
        "cli",
    ),
    "hw": (
        "runtime",
        "active_echo",
        "ultrasound",
        "robot",
        "midplane",
        "planning",
        "bench",
        "setup",
        "recording",
        "view",
        "acquisition",
        "freehand",
        "cli",
    ),
}
"""Folders of each package, the lowest first."""

ANSWERS = {
    # What a user asks of an answer is found out, told, drawn and written above it.
    "jaxcal.result.calibration": {
        "jaxcal.diagnostics.diagnose",
        "jaxcal.diagnostics.directions",
        "jaxcal.diagnostics.frame_checks",
        "jaxcal.diagnostics.intervals",
        "jaxcal.diagnostics.warnings",
        "jaxcal.report.in_memory",
        "jaxcal.report.page",
        "jaxcal.report.plots",
        "jaxcal.report.verdict",
        "jaxcal.report.write",
    },
    "jaxcal.calibration.pivot": {"jaxcal.report.pivot"},
    # ImageTransform.save and .text write what load_calibration makes an ImageTransform of.
    "jaxcal.result.transform": {"jaxcal.result.saved"},
    # Any study computes its chunks; the pipeline computes those of a Spec.
    "jaxcal.study.spec": {"jaxcal.study.pipeline"},
}
"""Imports within functions that close a circle, by module: methods that belong to the interface."""

Imports = dict[str, set[str]]


def sources() -> dict[str, Path]:
    """All modules by their names."""
    found = {}
    for package in ("jaxcal", "hw"):
        for path in (HOME / package).rglob("*.py"):
            parts = path.relative_to(HOME).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


@cache
def parsed(path: Path) -> ast.Module:
    """A module's tree; several tests read it."""
    return ast.parse(path.read_bytes())


def imports_of(path: Path, modules: dict[str, Path]) -> tuple[set[str], set[str]]:
    """Modules that a file imports at its head, TYPE_CHECKING included, and within functions."""
    head: set[str] = set()
    late: set[str] = set()

    def visit(node: ast.AST, found: set[str]) -> None:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            found = late
        elif isinstance(node, ast.Import):
            found.update(each.name for each in node.names if each.name in modules)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            for each in node.names:
                name = f"{node.module}.{each.name}"
                if (name if name in modules else node.module) in modules:
                    found.add(name if name in modules else str(node.module))
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.stmt | ast.ExceptHandler | ast.match_case):
                visit(child, found)

    visit(parsed(path), head)
    return head, late


def public_names(path: Path) -> bool:
    """Whether a file finds its names on first use and imports them for type checkers only."""
    return path.name == "__init__.py" and "def __getattr__(" in path.read_text()


@pytest.fixture(scope="module")
def graph() -> tuple[Imports, Imports]:
    """Imports at the head of every module, and those within its functions.

    ``jaxcal``, ``jaxcal.design`` and ``jaxcal.study`` import nothing that they name.
    """
    modules = sources()
    head, late = {}, {}
    for name, path in modules.items():
        head[name], late[name] = imports_of(path, modules)
        if public_names(path):
            head[name] = set()
    return head, late


def upwards(imports: Imports) -> list[str]:
    """Imports within a package of a folder above."""
    found = []
    for name, others in imports.items():
        package, *here = name.split(".")
        layers = LAYERS[package]
        for other in others:
            there = other.split(".")
            if here and here[0] in layers and there[0] == package and there[1:2]:
                above = there[1] in layers and layers.index(here[0]) < layers.index(there[1])
                if above:
                    found.append(f"{name} imports {other}")
    return sorted(found)


def circle(imports: Imports) -> str:
    """A circle of modules, in words; empty if there is none."""
    try:
        TopologicalSorter(imports).prepare()
    except CycleError as error:
        return " imports ".join(reversed(error.args[1]))
    return ""


@pytest.mark.parametrize("package", LAYERS)
def test_every_folder_has_a_layer(package):
    folders = {path.name for path in (HOME / package).iterdir() if (path / "__init__.py").exists()}
    assert folders == set(LAYERS[package])


def test_no_module_imports_upwards(graph):
    assert upwards(graph[0]) == []


def test_no_circle_of_imports(graph):
    assert circle(graph[0]) == ""


def test_jaxcal_imports_neither_hw_nor_experiments(graph):
    for imports in graph:
        for name, others in imports.items():
            if name.split(".")[0] == "jaxcal":
                assert not [other for other in others if other.split(".")[0] != "jaxcal"], name


def test_imports_within_functions_point_down_but_for_the_listed_ones(graph):
    head, late = graph
    for name, others in ANSWERS.items():
        assert others <= late[name], f"{name} no longer imports {others - late[name]}"
    listed: defaultdict[str, set[str]] = defaultdict(set, ANSWERS)
    rest = {name: others - listed[name] for name, others in late.items()}
    assert upwards(rest) == []
    assert circle({name: head[name] | rest[name] for name in head}) == ""


def test_a_circle_and_a_way_up_are_found():
    assert circle({"a": {"b"}, "b": {"c"}, "c": {"a"}}).count(" imports ") == 3
    assert upwards({"jaxcal.data.probe": {"jaxcal.io.text", "jaxcal.runtime.arrays"}}) == [
        "jaxcal.data.probe imports jaxcal.io.text"
    ]
    assert upwards({"hw.robot.gate": {"hw.cli.main", "hw.runtime.clock", "jaxcal.cli.main"}}) == [
        "hw.robot.gate imports hw.cli.main"
    ]


def test_jax_is_imported_before_its_parts():
    """Of two threads that import JAX, one by a part of it, each waits for what the other began.

    Python ends that with half a module. ``import jax`` and ``from jax import numpy`` wait in turn.
    """
    early = []
    for path in sources().values():
        nodes = list(ast.walk(parsed(path)))
        guards = [each for each in nodes if isinstance(each, ast.If)]
        unseen = {
            id(each)
            for guard in guards
            if ast.unparse(guard.test) == "TYPE_CHECKING"
            for each in ast.walk(guard)
        }
        whole = False
        for node in sorted(
            (each for each in nodes if isinstance(each, ast.Import | ast.ImportFrom)),
            key=lambda each: each.lineno,
        ):
            if id(node) in unseen:
                continue
            names = (
                [each.name for each in node.names]
                if isinstance(node, ast.Import)
                else [node.module or ""]
            )
            whole = whole or not {"jax", "equinox", "optimistix"}.isdisjoint(names)
            if not whole and any(name.startswith("jax.") for name in names):
                early.append(f"{path.relative_to(HOME)}:{node.lineno}")
    assert not early


REFERENCE = re.compile(r":(?:mod|class|func|meth|data|attr|exc):`([A-Za-z_][\w.]*)`")
"""What a docstring refers to: by its full name, or by one that its own module knows."""
OTHERS = {"jax", "optimistix", "socket"}
"""Packages of others that are referred to by their full names."""


def names_in(body: list[ast.stmt], *, members: bool = True) -> set[str]:
    """Names that a module defines or imports at its head, and members of its classes."""
    found: set[str] = set()
    for node in body:
        if isinstance(node, ast.If | ast.Try):
            found |= names_in(node.body, members=members)
        elif isinstance(node, ast.ClassDef | ast.FunctionDef):
            found.add(node.name)
            if members and isinstance(node, ast.ClassDef):
                found |= names_in(node.body)
        elif isinstance(node, ast.Import | ast.ImportFrom):
            found.update(each.asname or each.name for each in node.names)
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names = (name for target in targets for name in ast.walk(target))
            found.update(name.id for name in names if isinstance(name, ast.Name))
    return found


def test_docstrings_refer_to_what_is_there():
    modules = sources()
    known: dict[tuple[str, bool], set[str]] = {}
    missing = []
    for here, path in modules.items():
        for target in REFERENCE.findall(path.read_text("utf-8")):
            parts = target.split(".")
            lengths = range(len(parts), 0, -1)
            full = (name for k in lengths if (name := ".".join(parts[:k])) in modules)
            module = next(full, here)
            own = parts[0] not in ("jaxcal", "hw")
            first = parts[0] if own else target[len(module) + 1 :].split(".")[0]
            if (module, own) not in known:
                found = names_in(parsed(modules[module]).body, members=own)
                known[module, own] = found | (OTHERS if own else {""})
            if first not in known[module, own]:
                missing.append(f"{here}: {target}")
    assert not missing


LINUX_ONLY = ("hw.robot.mover", "hw.robot.motion", "hw.bench")
"""What moves a robot, and the emulated bench with its pseudo-terminals."""

NOT_ON_WINDOWS = {
    "os": (
        "fork forkpty openpty ttyname mkfifo mknod kill killpg getpgid getpgrp setsid statvfs "
        "fstatvfs pread pwrite posix_fallocate posix_fadvise posix_spawn getuid geteuid getgid "
        "getegid fchmod fchown chown wait3 wait4 WIFEXITED WEXITSTATUS sched_setaffinity "
        "sched_getaffinity sched_setscheduler sched_param SCHED_FIFO SCHED_OTHER getloadavg nice "
        "uname sync fdatasync sendfile tcgetpgrp tcsetpgrp O_DIRECTORY O_NOFOLLOW O_CLOEXEC "
        "O_NONBLOCK register_at_fork memfd_create"
    ),
    "signal": (
        "SIGKILL SIGHUP SIGSTOP SIGCONT SIGTSTP SIGALRM SIGUSR1 SIGUSR2 SIGCHLD SIGPIPE SIGQUIT "
        "pthread_kill pthread_sigmask sigwait sigtimedwait sigpending setitimer alarm pause "
        "siginterrupt"
    ),
    "select": "poll epoll",
}
MODULES_NOT_ON_WINDOWS = {"fcntl", "resource", "termios", "tty", "pty", "pwd", "grp"}


def unguarded(source: str) -> list[str]:
    """Names that Windows lacks where nothing asks whether they are there."""
    found: list[str] = []

    def visit(node: ast.AST, guarded: bool) -> None:
        if isinstance(node, ast.If | ast.IfExp | ast.While | ast.BoolOp):
            asked = ast.unparse(node if isinstance(node, ast.BoolOp) else node.test)
            guarded |= any(text in asked for text in ("hasattr(", "os.name", "sys.platform"))
        elif isinstance(node, ast.Try):
            caught = " ".join(ast.unparse(each.type) for each in node.handlers if each.type)
            guarded |= "AttributeError" in caught or "ImportError" in caught
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            if not guarded and node.attr in NOT_ON_WINDOWS.get(node.value.id, "").split():
                found.append(ast.unparse(node))
        elif isinstance(node, ast.Import | ast.ImportFrom) and not guarded:
            names = {each.name for each in node.names} | {getattr(node, "module", None)}
            found.extend(sorted(names & MODULES_NOT_ON_WINDOWS))
        for child in ast.iter_child_nodes(node):
            visit(child, guarded)

    visit(ast.parse(source), False)
    return found


def test_what_windows_lacks_is_asked_for():
    """Nobody runs these tests there: a recording of the bench once failed at every flush."""
    wrong = "import fcntl\nif ready:\n    os.fstatvfs(1)\nhasattr(os, 'nice') and os.nice(1)"
    assert unguarded(wrong) == ["fcntl", "os.fstatvfs"]
    found = {
        name: names
        for name, path in sources().items()
        if not name.startswith(LINUX_ONLY) and (names := unguarded(path.read_text("utf-8")))
    }
    # Who calls these asks first: a POSIX terminal, and a worker that watches its parent.
    assert found == {
        "hw.runtime.keys": ["tty", "termios", "os.tcgetpgrp", "os.getpgrp"],
        "jaxcal.study.workers": ["select.poll"],
    }


def test_figures_leave_pyplot_alone():
    """It would change the state, and perhaps open windows, of whoever uses the library."""
    for path in (HOME / "jaxcal").rglob("*.py"):
        assert "pyplot" not in re.sub(r"#.*|\"\"\"[\s\S]*?\"\"\"", "", path.read_text()), path
