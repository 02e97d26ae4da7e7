"""What the subcommands of `codesign` do, once their flags are parsed."""
