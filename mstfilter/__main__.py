"""Run the command line by ``python -m mstfilter``."""

from mstfilter.app.cli import main

main()
