"""The command `improvo`, and `python -m improvo`."""

import sys


def main() -> int:
    """Run the command line, which takes some time to load: who interrupts that gets no traceback either."""
    try:
        from improvo.cli.main import main as run
    except KeyboardInterrupt:
        print("improvo: interrupted", file=sys.stderr)
        return 130
    return run()


if __name__ == "__main__":
    sys.exit(main())
