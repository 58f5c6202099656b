"""Runs the command line as `python -m bayeskin`."""

from bayeskin.cli import main

main()
