"""`python -m meshanim`: the command line, for launchers such as torchrun that take a module."""

import sys

from meshanim.cli import main

sys.exit(main())
