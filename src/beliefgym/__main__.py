"""`python -m beliefgym`."""

from beliefgym.scripts.cli import main

main()
