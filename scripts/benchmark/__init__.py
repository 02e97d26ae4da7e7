"""Rates of this engine and of its peers, in whole grasps a second."""
