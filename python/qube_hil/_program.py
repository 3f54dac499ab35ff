"""The command ``qube-hil``, which the package contains."""

import os
import signal
import sys

from ._core import main as _main


def main() -> int:
    """Runs the program with the arguments of this process and returns its exit code."""
    # The program handles Ctrl-C itself. Python's handler would only note the signal until the program returns.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    return _main(os.path.abspath(sys.argv[0]), ["qube-hil", *sys.argv[1:]])
