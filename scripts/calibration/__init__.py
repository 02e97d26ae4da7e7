"""History matching over the scene's constants that the paper does not publish.

A *set* is one value for each open constant (`sets.OPEN`).  A *wave* simulates a coarse landscape
of the 2D experiment for many sets, all in one compiled program: the constants are data.  Landscapes
are summarised (`summary`), a particle filter runs on them in place of the simulation (`surrogate`),
and the targets that the paper's text gives say which sets are implausible (`score`); the others
seed the next wave.
"""
