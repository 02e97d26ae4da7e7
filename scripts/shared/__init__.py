"""What the studies share: statistics, tables, figures, provenance, work to measure, state files."""
