"""The table of docs/faults.md, from the counts."""
def write(data, path):
    pass
