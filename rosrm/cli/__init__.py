"""The `rosrm` command. Only `rosrm.cli.output.top` is of use to other programs."""
