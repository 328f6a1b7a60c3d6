"""The `rosrm` command. Only `rosrm.cli.live` is of use to other programs."""
