"""All campaigns, in the order in which they are run: the longest at the end."""

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

_MODULES = (kills, products, checkpoints, folders, strangers, caches, numbers, long, inputs)
CAMPAIGNS: dict[str, Campaign] = {c.name: c for module in _MODULES for c in module.CAMPAIGNS}
