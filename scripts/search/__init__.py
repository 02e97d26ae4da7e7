"""Optimisers compared over many seeds with equal numbers of grasps."""
