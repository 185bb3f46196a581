"""Start the console program `tofclip`; `python -m tofclip` does the same.

This is in a package of its own name, so that an unrelated package called ``apps`` elsewhere on the
path cannot take the program's place.
"""

from __future__ import annotations

import sys

PROGRAM_PACKAGE = "apps"
EXIT_MISSING, EXIT_INTERRUPTED = 2, 130


def main() -> int:
    """Run the program and return its exit status; Ctrl-C ends it in one line even while it starts."""
    try:
        # Not above: while modules are loaded there, nothing would catch a Ctrl-C.
        import importlib
        import importlib.util
        from pathlib import Path

        # The folder of this package comes first if its neighbour would not be found otherwise.
        root = Path(__file__).resolve().parents[1]
        spec = importlib.util.find_spec(PROGRAM_PACKAGE)
        own = root / PROGRAM_PACKAGE / "__init__.py"
        if spec is None or spec.origin is None or Path(spec.origin).resolve() != own:
            sys.path.insert(0, str(root))
            importlib.invalidate_caches()
        status: int = importlib.import_module(f"{PROGRAM_PACKAGE}.cli").main()
    except ImportError as fault:  # typer and rich are needed before any verb
        from tofclip.files import describe_missing_package

        missing = describe_missing_package(fault)
        if missing is None:
            raise
        print(f"tofclip: error: {missing}", file=sys.stderr)
        return EXIT_MISSING
    except KeyboardInterrupt:
        print("tofclip: interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED
    return status


if __name__ == "__main__":
    sys.exit(main())
