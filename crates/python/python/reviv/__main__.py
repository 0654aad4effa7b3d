"""The command line: ``reviv ...`` and ``python -m reviv ...``."""

import signal
import sys

from . import _reviv


def main() -> int:
    """Runs the command line with the arguments of the process; returns its exit code."""
    # The program handles Ctrl-C itself: a run stops where it can be continued.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    return _reviv.main(["reviv", *sys.argv[1:]], _reviv.__file__, sys.executable or "")


if __name__ == "__main__":
    sys.exit(main())
