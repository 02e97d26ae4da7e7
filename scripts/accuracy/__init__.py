"""Accuracy against time in the default scene, and its error budget."""
