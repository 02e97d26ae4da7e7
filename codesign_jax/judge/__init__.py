"""What decides: when a world is decided, how a trial ended, and whether a design is good.

* `verdict`: the bounds that engines and kernels apply to a world, the ending of a trial, and Wald's
  sequential test of a design.  It knows scenes and outcomes alone, so that engines may import it.
* `cases`: a design with what simulates it.
* `fresh_trials`: trials that a search has not met, until they decide.
* `stress`: the same design under other conditions.
* `worth`: the same design without some of its fingers.
* `sentences`: all of it in words.
"""
