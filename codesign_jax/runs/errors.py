"""How a run fails in a way that its user can do something about."""


class RunError(RuntimeError):
    """A run cannot go on; the message says why, and what to do."""


class AllFailed(RunError):
    """Every trial of an episode or of the final test failed; there is nothing to optimise."""
