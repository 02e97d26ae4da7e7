"""The licence for a change of the simulation: this checkout beside an older one."""
