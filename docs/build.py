"""Build the documentation: ``python docs/build.py``.

Without options it writes the command line's reference, checks links, words, names and numbers, and
builds the site strictly into ``build/site``. ``--execute`` first runs every block of every page
and renews what the pages show of it; ``--execute PAGE...`` only those of these pages.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "tools"))

# A figure looks the same wherever the site is built; nothing asks for a display.
os.environ.setdefault("MPLBACKEND", "agg")
os.environ.setdefault("NO_MKDOCS_2_WARNING", "1")
os.environ.setdefault("SOURCE_DATE_EPOCH", "0")
os.environ.setdefault("MATPLOTLIBRC", str(Path(__file__).parent / "tools" / "matplotlibrc"))


def main() -> int:
    """Run the command line; returns the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--execute", nargs="*", metavar="PAGE", help="run the pages' blocks first")
    parser.add_argument(
        "--check", action="store_true", help="with --execute: write nothing, compare outputs"
    )
    parser.add_argument("--external", action="store_true", help="list links to other sites")
    parser.add_argument("--no-site", action="store_true", help="build no site")
    options = parser.parse_args()

    import checks
    import command_line
    import pages

    if options.external:
        print("\n".join(checks.external_links()))
        return 0
    if options.execute is not None:
        chosen = [Path(page).resolve() for page in options.execute] or pages.pages()
        failed = 0
        for page, done in pages.run_all(chosen, write=not options.check):
            if isinstance(done, pages.PageError):
                failed += 1
                print(done, file=sys.stderr, flush=True)
            else:
                print(f"{pages.name_of(page)}: {done.seconds:.1f} s", flush=True)
        if failed:
            return 1
    if not options.check:
        command_line.write()
    problems = checks.all_problems()
    if problems:
        print("\n".join(problems), file=sys.stderr)
        return 1
    if options.no_site:
        return 0
    build = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet"]
    return subprocess.run(build, cwd=pages.ROOT).returncode


if __name__ == "__main__":
    sys.exit(main())
