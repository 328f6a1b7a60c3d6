"""`python -m rosrm.cli` is the `rosrm` command."""

from rosrm.cli.app import main

if __name__ == "__main__":
    main()
