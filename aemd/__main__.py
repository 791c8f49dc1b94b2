"""`python -m aemd` is `aemd`."""

from aemd.cli import main

main()
