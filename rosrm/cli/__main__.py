"""Entry point of `python -m rosrm.cli`, which is the `rosrm` command."""

from rosrm.cli.app import main

if __name__ == "__main__":
    main()
