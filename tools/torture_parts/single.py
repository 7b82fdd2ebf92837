"""Run one verb with the small field of the trials: `python -m tools.torture_parts.single ARGS`."""

import sys

from tools.torture_parts.zygote import use_small_field


def main() -> int:
    """Run the command line."""
    use_small_field()
    from climatenerf import cli

    return cli.main(sys.argv[1:])


if __name__ == "__main__":
    sys.exit(main())
