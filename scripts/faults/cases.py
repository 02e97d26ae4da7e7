"""All campaigns, in the order in which they are run."""

from scripts.faults import checkpoints, folders, kills
from scripts.faults.campaigns import Campaign

_MODULES = (kills, checkpoints, folders)
CAMPAIGNS: dict[str, Campaign] = {c.name: c for module in _MODULES for c in module.CAMPAIGNS}
