"""What `sfm-calib` and `python -m sfm_calib` start; processes that they start load it too, so it is
light."""

from __future__ import annotations

import sys

EXIT_INTERRUPTED = 130  # as a shell says it of Ctrl-C


def main() -> int:
    """Load the command line, which takes seconds, and run it; the exit code."""
    try:
        from sfm_calib.cli import main as run
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    return run()


if __name__ == "__main__":
    sys.exit(main())
