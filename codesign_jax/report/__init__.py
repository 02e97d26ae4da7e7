"""Figures, animations and words; nothing numerical imports this package."""
