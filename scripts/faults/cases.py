"""All campaigns, in the order in which they are run."""

from scripts.faults import (
    caches,
    checkpoints,
    folders,
    inputs,
    kills,
    long,
    numbers,
    products,
    strangers,
)
from scripts.faults.campaigns import Campaign

_MODULES = (kills, products, checkpoints, folders, strangers, caches, inputs, numbers, long)
CAMPAIGNS: dict[str, Campaign] = {c.name: c for module in _MODULES for c in module.CAMPAIGNS}
