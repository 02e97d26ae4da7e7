"""Labelled grasps of `codesign sample`: their datasheet, and a surrogate that learns from them."""
