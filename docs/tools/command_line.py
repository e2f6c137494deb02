"""The reference of the command line, written from what ``--help`` says."""

from __future__ import annotations

import click
from pages import DOCS

PAGE = DOCS / "reference" / "command-line.md"

_HEAD = """# Command line

<!-- Written by docs/build.py from what --help says: change the commands, not this page. -->

Every command prints its options with `--help`. `jaxcal` calibrates, `jaxcal-hw` acquires.

| exit status | `jaxcal` | `jaxcal-hw` |
| --- | --- | --- |
| 0 | converged | done |
| 1 | an internal error, in one line; `JAXCAL_TRACEBACK=1` shows where | the same |
| 2 | bad usage or input (nothing was written), or an output cannot be written (other files may have been written); one line says what | the same |
| 3 | solved, but did not converge, is not determined by the images, or used data in wrong frames or units; of `import` and `segment`: most frames or points were left out | done, but the calibration did not converge |
| 4 | | a device failed: motion has ended, `--resume` continues; of `check`: a device has a fault |
| 5 | converged, but less accurate than `--require` (by default fair), or the poses may not be in mm; of `pivot`: the SD of the tip exceeds 1 mm; of `compare`: two calibrations differ | done, but the calibration is less than fair |
| 130 | Ctrl-C | Ctrl-C: motion has ended, `--resume` continues |

`eval "$(_JAXCAL_COMPLETE=bash_source jaxcal)"` in `~/.bashrc` completes commands and options (`zsh_source` and
`fish_source` for these shells; `_JAXCAL_HW_COMPLETE` for `jaxcal-hw`).

"""  # noqa: E501

WIDTH = 100


def text() -> str:
    """The page."""
    from hw.cli.main import commands as bench
    from jaxcal.cli.main import commands as engine

    parts = [_HEAD.rstrip()]
    for name, group in (("jaxcal", engine), ("jaxcal-hw", bench)):
        for path, command in _commands(name, group):
            context = click.Context(
                command, info_name=path, terminal_width=WIDTH, max_content_width=WIDTH
            )
            context.help_option_names = ["-h", "--help"]
            shown = command.get_help(context).replace("\b\n", "")
            parts.append(f"## `{path}`\n\n```text\n{shown.rstrip()}\n```")
    return "\n\n".join(parts) + "\n"


def _commands(path: str, command: click.Command) -> list[tuple[str, click.Command]]:
    found = [(path, command)]
    if isinstance(command, click.Group):
        for name in sorted(command.commands):
            found += _commands(f"{path} {name}", command.commands[name])
    return found


def write() -> None:
    """Write the page if it changed."""
    if not PAGE.exists() or PAGE.read_text(encoding="utf-8") != text():
        PAGE.write_text(text(), encoding="utf-8")
