"""All campaigns, in the order in which they are run."""

from scripts.faults import kills
from scripts.faults.campaigns import Campaign

CAMPAIGNS: dict[str, Campaign] = {c.name: c for c in (*kills.CAMPAIGNS,)}
