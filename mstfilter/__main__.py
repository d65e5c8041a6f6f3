"""Run the command line by ``python -m mstfilter``."""

from mstfilter.cli import main

main()
