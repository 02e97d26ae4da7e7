"""Measures engines against each other: work, timing, errors; `python -m` runs a single case."""
