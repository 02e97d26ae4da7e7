"""Studies and tools of a checkout; run one with `python -m scripts.NAME`, see scripts/README.md."""
