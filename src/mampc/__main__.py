"""`python -m mampc` is the command line."""

from mampc.cli import main

main()
