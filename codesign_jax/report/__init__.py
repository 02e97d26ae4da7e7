"""Figures and animations; nothing numerical imports this package, and it needs the extra `viz`."""
