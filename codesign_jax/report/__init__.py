"""Figures and animations; nothing numerical imports this package.

>>> from codesign_jax.report import statistics
>>> share = statistics.wilson(3, 3)  # three of three trials kept: how sure is that?
>>> round(share.low, 2), share.high
(0.44, 1.0)
"""
