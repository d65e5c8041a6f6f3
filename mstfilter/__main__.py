"""``python -m mstfilter``: the command line."""

from mstfilter.cli import main

main()
