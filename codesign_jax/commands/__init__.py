"""Implementations of the subcommands of `codesign`."""
