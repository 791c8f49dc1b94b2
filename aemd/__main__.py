"""`aemd`, and `python -m aemd`: the command line, from its first import on."""

import sys

__all__ = ["main"]


def main() -> None:
    """Run the command line; who interrupts it while it is still being imported gets the same line as later."""
    try:
        from aemd.cli import main as run  # noqa: PLC0415 - the import is what may be interrupted
    except KeyboardInterrupt:
        print("aemd: interrupted", file=sys.stderr)
        sys.exit(130)
    run()


if __name__ == "__main__":
    main()
