"""`python -m swimm3r` is `swimm3r`."""

from swimm3r.cli.main import main

main()
