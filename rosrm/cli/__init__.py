"""The `rosrm` command. Other programs may import `rosrm.cli.output.top` only."""
