"""python -m scripts.benchmark.case CASE.json RECORDS.jsonl: runs one case."""

import json
import sys
from pathlib import Path

from scripts.benchmark.cases import Case

if __name__ == "__main__":
    Case(json.loads(Path(sys.argv[1]).read_text()), Path(sys.argv[2])).run()
